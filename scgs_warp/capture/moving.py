"""Which pixels show something that moves by itself: given masks, or motion that disagrees with the scene at rest.

Between two frames, what stands still moves along its epipolar lines, wherever it is. A fundamental matrix that fits
most of the optical flow is that of the camera's motion; pixels whose flow leaves its lines move by themselves. (What
moves along the lines, as a car does ahead of one that follows it, is not found; robust matching copes with the rest.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from ..data.images import size_text
from ..errors import UserError
from .source import Folder, Source, open_source, read_rgb, shrunk

SIDE = 480
"""Longer side of the images in which flow is computed, pixels."""
STEPS = (-2, -1, 1, 2)
"""Frames that each frame is compared with."""
GRID = 12
"""Every so many pixels a flow vector takes part in the search for the camera's motion."""
FEWEST = 60
"""Flow vectors without which no motion is sought."""
OFF_LINE = 1.5
"""Pixels of ``SIDE`` from the epipolar line that flow is never that wrong by ..."""
OFF_TYPICAL = 6.0
"""... unless it usually is: times the median distance."""
RETURN = 1.5
"""Pixels that flow forth and back may end from where it began; more, and the pixel is hidden in one of the frames."""
TEXTURE = 4.0
"""Grey levels of local contrast without which flow is a guess."""
AGREE = 0.5
"""Share of the comparisons in which a pixel must move by itself."""
LARGEST = 0.5
"""A mask of more than this share of the frame says that the search has failed."""
GROW = 0.015
"""Masks are widened by this share of ``SIDE``: flow is blurred at outlines."""
SPECK = 0.001
"""Smaller areas, as shares of the frame, are errors of the flow."""


def consensus(load: Callable[[int], np.ndarray], count: int, done: Callable[[], object]) -> list[np.ndarray]:
    """Masks of ``count`` frames.

    Args:
        load: frame number -> [H, W, 3] uint8 RGB.
        done: called after each frame.

    Returns:
        [H, W] bool at the frames' size, True where something moves by itself.
    """
    kept: dict[int, np.ndarray] = {}
    flows: dict[tuple[int, int], np.ndarray] = {}
    masks = []
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def flow(one: int, two: int) -> np.ndarray:
        if (one, two) not in flows:
            flows[one, two] = search.calc(kept[one], kept[two], None)  # type: ignore[call-overload]
        return flows[one, two]

    size = (0, 0)
    for index in range(count):
        around = [index + step for step in STEPS if 0 <= index + step < count]
        for k in (index, *around):
            if k not in kept:
                image = load(k)
                kept[k], size = _gray(image), (image.shape[1], image.shape[0])
        votes, asked = np.zeros(kept[index].shape, np.float32), np.zeros(kept[index].shape, np.float32)
        for other in around:
            answer = off_line(kept[index], flow(index, other), flow(other, index))
            if answer is not None:
                moves, sure = answer
                votes += moves & sure
                asked += sure
        mask = (votes >= 1) & (votes >= AGREE * asked)
        masks.append(_tidy(mask, size))
        gone = index + min(STEPS)
        kept.pop(gone, None)
        flows = {pair: found for pair, found in flows.items() if min(pair) > gone}
        done()
    return masks


def _gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(shrunk(image, SIDE), cv2.COLOR_RGB2GRAY)


def off_line(one: np.ndarray, forth: np.ndarray, back: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Which pixels of an image leave their epipolar lines on the way to another, and of which that can be said.

    Args:
        one: [H, W] uint8.
        forth, back: [H, W, 2] flow from it to the other image, and from that to it.

    Returns:
        [H, W] bool twice; None where no motion of the camera is found.
    """
    height, width = one.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    there = np.stack([x, y], 2) + forth
    returned = cv2.remap(back, there[..., 0], there[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (there >= 0).all(2) & (there[..., 0] < width) & (there[..., 1] < height)
    sure = inside & (np.square(forth + returned).sum(2) < RETURN**2) & _textured(one)
    chosen = np.zeros_like(sure)
    chosen[GRID // 2 :: GRID, GRID // 2 :: GRID] = True
    chosen &= sure
    if chosen.sum() < FEWEST:
        return None
    here = np.stack([x, y], 2)
    matrix, _ = cv2.findFundamentalMat(here[chosen], there[chosen], cv2.USAC_MAGSAC, 0.5, 0.999, 2000)
    if matrix is None or matrix.shape != (3, 3):
        return None
    distance = sampson(matrix, here, there)
    limit = max(OFF_LINE, OFF_TYPICAL * float(np.median(distance[sure])))
    return distance > limit, sure


def _textured(gray: np.ndarray) -> np.ndarray:
    values = gray.astype(np.float32)
    mean = cv2.blur(values, (9, 9))
    return cv2.blur(values * values, (9, 9)) - mean * mean > TEXTURE**2


def sampson(matrix: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """[...] distance in pixels of pairs of points [..., 2] from a fundamental matrix, to first order."""
    ones = np.ones((*here.shape[:-1], 1))
    a, b = np.concatenate([here, ones], -1), np.concatenate([there, ones], -1)
    lines, back = a @ matrix.T, b @ matrix
    slope = np.square(lines[..., :2]).sum(-1) + np.square(back[..., :2]).sum(-1)
    return np.abs((b * lines).sum(-1)) / np.sqrt(np.maximum(slope, 1e-18))


def _tidy(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Without specks and holes, widened, at ``size`` (width, height); nothing where too much is left."""
    reach = max(1, round(GROW * max(mask.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    pixels = cv2.medianBlur(mask.astype(np.uint8), 5)
    pixels = cv2.morphologyEx(pixels, cv2.MORPH_CLOSE, disc)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(pixels)
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= SPECK * mask.size]
    pixels = cv2.dilate(np.isin(labels, large).astype(np.uint8), disc)
    if pixels.mean() > LARGEST:
        pixels[:] = 0
    return cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST).astype(bool)


def given(path: Path, source: Source, indices: Sequence[int], names: Sequence[str], size: tuple[int, int]) -> list:
    """Masks that the user made: black where something moves, as COLMAP and nerfstudio have it.

    A video of masks, or a folder with one for each frame of the source: of the same name for a folder of images, in the
    order of names for a video; a folder may also have masks of the picked frames only, named by their numbers.

    Args:
        indices, names: of the picked frames.
        size: (width, height) of the frames.

    Returns:
        [H, W] bool at ``size``, True where something moves.

    Raises:
        UserError: there are no masks, or they do not belong to the frames.
    """
    masks = open_source(path)
    wanted = set(indices)
    if isinstance(masks, Folder):
        files = _paired(masks, source, indices, names)
        images = [read_rgb(file) for file in files]
    else:
        found = {still.index: still.image for still in masks.frames(max(size)) if still.index in wanted}
        missing = sorted(wanted - found.keys())
        if missing:
            raise UserError(
                f"{path}: ends before frame {missing[0]} of {source.path}; give a mask for each frame of the video"
            )
        images = [found[index] for index in indices]
    return [_given(image, path, size) for image in images]


def _given(image: np.ndarray, path: Path, size: tuple[int, int]) -> np.ndarray:
    ratio = image.shape[1] / image.shape[0] / (size[0] / size[1])
    if abs(ratio - 1) > 0.02:
        raise UserError(
            f"{path}: holds masks of {size_text(image.shape[1::-1])}, frames are {size_text(size)}; give masks of the "
            "frames' proportions"
        )
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).max(2) < 128


def _paired(masks: Folder, source: Source, indices: Sequence[int], names: Sequence[str]) -> list[Path]:
    """The mask of each picked frame."""
    by_name = {file.name: file for file in masks.files} | {file.stem: file for file in masks.files}
    if not source.video:
        keys = [next((key for key in (f"{name}.png", Path(name).stem) if key in by_name), name) for name in names]
    elif len(masks.files) > max(indices):
        return [masks.files[index] for index in indices]
    else:
        keys = [frame_name(index) for index in indices]
    missing = [key for key in keys if key not in by_name]
    if missing:
        raise UserError(
            f"{masks.path}: no mask for {Path(missing[0]).stem} ({len(missing)} of {len(keys)} are missing); name "
            "masks as their frames, or give one for each frame of the video"
        )
    return [by_name[key] for key in keys]


def frame_name(index: int) -> str:
    """Of a picked frame, without suffix."""
    return f"frame_{index:05d}"
