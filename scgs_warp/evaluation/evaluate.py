"""Evaluation of a scene: the metrics of one split, as reported by training and ``apps/evaluate.py``."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..data import Dataset
from ..errors import UserError
from ..scene.frame_colors import FrameColors, apply_color, fitted_color
from ..scene.scene import Scene
from ..storage.checkpoint import DISK_FULL
from ..storage.files import write_atomically
from ..storage.output_folders import make_parent
from ..storage.png_files import write_png
from ..types import Frame
from ..visualization.figures import contact_sheet, to_bytes
from .coverage import compare_alpha, coverage_row, summarise
from .image_metrics import psnr, ssim
from .motion_metrics import load_ground_truth, score_motion
from .thin_structures import RodCheck, load_rods

MOST_DECIBELS = 100.0
"""PSNR of an image that equals the truth, such as one that shows the background alone. Infinity would be the mean of
all images."""
SHEET_ROWS = 8
"""Number of images on a contact sheet, evenly spread over the split."""

Lpips = Callable[[Tensor, Tensor], Tensor | float]


def _mean(values: list[float]) -> float | None:
    """Return the mean, summed exactly so that the order of the images does not matter; None for an empty list."""
    return math.fsum(values) / len(values) if values else None


def _decibels(image: Tensor, truth: Tensor) -> float:
    """Return the PSNR, at most ``MOST_DECIBELS``."""
    value = float(psnr(image, truth))
    return value if math.isnan(value) else min(value, MOST_DECIBELS)


def _recolored(image: Tensor, color: Tensor) -> Tensor:
    """Apply an affine colour [3, 4] to an image [H, W, 3]."""
    return apply_color(color.to(image.device), image.permute(2, 0, 1)).permute(1, 2, 0).clamp(0.0, 1.0)


def _color_scores(frame: Frame, image: Tensor, truth: Tensor, colors: FrameColors | None) -> dict[str, float]:
    """Score an image with the colour that the frames before and after have, and with the colour that fits best."""
    mask = None if frame.mask is None else frame.mask.to(image.device)
    shown = {"fitted": _recolored(image, fitted_color(image, truth, mask))}
    if colors is not None:
        shown["interpolated"] = _recolored(image, colors.at(frame.time))
    scores = {}
    for name, picture in shown.items():
        scores[f"psnr_{name}"] = _decibels(picture, truth) if mask is None else _decibels(picture[mask], truth[mask])
        scores[f"ssim_{name}"] = float(ssim(picture, truth, mask))
    return scores


def _measure(
    frame: Frame, image: Tensor, alpha: Tensor, truth: Tensor, covisible: Tensor | None, lpips: Lpips | None
) -> dict[str, Any]:
    """Measure one image; ``image`` and ``truth`` are [H, W, 3] in [0, 1], ``alpha`` is [H, W], on the scene's device;
    ``covisible`` is [H, W] bool."""
    mask = None if frame.mask is None else frame.mask.to(image.device)
    row: dict[str, Any] = {"name": frame.name, "time": float(frame.time)}
    row["psnr"] = _decibels(image, truth) if mask is None else _decibels(image[mask], truth[mask])
    row["ssim"] = float(ssim(image, truth, mask))
    if covisible is not None:
        seen = covisible.to(image.device) if mask is None else covisible.to(image.device) & mask
        if bool(seen.any()):
            row["mpsnr"] = _decibels(image[seen], truth[seen])
    if lpips is not None:
        if mask is not None:  # outside the mask the truth is unknown: show no difference
            image = torch.where(mask[..., None], image, truth)
        row["lpips"] = float(lpips(image, truth))
    if frame.alpha is not None:
        row.update(coverage_row(compare_alpha(alpha, frame.alpha.to(alpha.device), mask)))
    return row


class _Renders:
    """Writer of renders and ground truth; keeps some pairs of both for the contact sheet."""

    def __init__(self, folder: Path, count: int, background: tuple[float, ...]) -> None:
        self.folder, self._background = folder, background
        rows = min(SHEET_ROWS, count)
        self._chosen = {round(index * (count - 1) / max(rows - 1, 1)) for index in range(rows)}
        self._names: set[str] = set()
        self._rows: list[tuple[Any, Any]] = []
        self._titles: list[str] = []
        self._scores: list[float] = []
        self._alphas: list[tuple[Tensor, Tensor] | None] = []
        try:
            for name in ("renders", "truth"):
                (folder / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{folder}: cannot be written ({error.strerror}); make the folder writable") from None

    def add(self, row: dict[str, Any], index: int, frame: Frame, image: Tensor, alpha: Tensor, truth: Tensor) -> None:
        name, score = row["name"], row["psnr"]
        self._names.add(f"{name}.png")
        pair = to_bytes(truth), to_bytes(image)
        self._write(self.folder / "truth" / f"{name}.png", pair[0])
        self._write(self.folder / "renders" / f"{name}.png", pair[1])
        if index in self._chosen:
            if frame.mask is not None:  # outside the mask the truth is unknown: show no error
                known = frame.mask.to(image.device)
                pair = pair[0], to_bytes(torch.where(known[..., None], image, truth))
                alpha = alpha if frame.alpha is None else torch.where(known, alpha, frame.alpha.to(alpha.device))
            self._rows.append(pair)
            self._scores.append(score)
            self._alphas.append(None if frame.alpha is None else (frame.alpha.cpu(), alpha.cpu()))
            self._titles.append(f"{name}   t = {frame.time:.3f}")

    def finish(self) -> None:
        """Write the contact sheet, and remove pictures of frames that an earlier evaluation had and this one has not:
        programs that score folders of pictures would count them."""
        for path in [*(self.folder / "renders").glob("*.png"), *(self.folder / "truth").glob("*.png")]:
            if path.name not in self._names:
                with suppress(OSError):
                    path.unlink()
        if self._rows:
            more = {"scores": self._scores, "alphas": self._alphas, "background": self._background}
            self._write(self.folder / "contact_sheet.png", contact_sheet(self._rows, self._titles, **more))

    @staticmethod
    def _write(path: Path, image: Any) -> None:
        try:
            write_png(path, image)
        except OSError as error:
            full = error.errno in DISK_FULL
            remedy = "free space there" if full else "copy the run to a folder that can be written"
            raise UserError(f"{path}: cannot be written ({error.strerror}); {remedy}") from None


def distinct_names(names: list[str]) -> list[str]:
    """Return names for files, one per frame: that of the frame, with the frame's number if an earlier one has it."""
    found: dict[str, None] = {}
    for index, name in enumerate(names):
        chosen = name or f"{index:05d}"
        if chosen in found:
            chosen = f"{name}_{index:05d}"
        while chosen in found:
            chosen += "_"
        found[chosen] = None
    return list(found)


@torch.no_grad()
def evaluate(
    scene: Scene,
    dataset: Dataset,
    *,
    lpips: Lpips | None = None,
    render_dir: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[int, Frame, Tensor], None] | None = None,
    colors: FrameColors | None = None,
    fit_color: bool = False,
) -> dict[str, Any]:
    """Render every frame of a split and compare it with the truth; a metric is the mean over the clamped images.

    Args:
        scene: the scene to render.
        dataset: the truth. Render and truth are composited on the data set's background colour, or on black if that is
            ``random``.
        lpips: function from (image, truth), both [H, W, 3] in [0, 1], to their perceptual distance; None: not measured.
        render_dir: folder for ``renders/NAME.png``, ``truth/NAME.png`` and ``contact_sheet.png``; None: not written.
        progress: called with (done, total) after each image.
        watch: called with (index, frame, rendered alpha [H, W]) after each image.
        colors: affine colours of the training frames, if the run learnt them; scores with colours are added then.
        fit_color: also score each image with the affine colour that fits it best.

    Returns:
        ``psnr`` [dB], ``ssim``, ``lpips`` (None if not measured), ``images``; ``mpsnr``, if the data have masks of what
        is covisible, the mean of the PSNR of the pixels that they mark; ``psnr_median``; ``psnr_worst`` and
        ``psnr_worst_time``, the lowest PSNR of an image and the image's time; with colours, ``psnr_fitted`` and
        ``ssim_fitted`` with the affine colour that fits each image best, and ``psnr_interpolated`` and
        ``ssim_interpolated`` with that of the training frames before and after; the fields of ``coverage.summarise``;
        and ``per_image``, a list of ``name``, ``time``, ``psnr``, ``ssim`` (``mpsnr``, ``lpips``; ``missing``,
        ``extra`` and their regions if the image has alpha). The metrics of an empty split are None.

    Raises:
        UserError: ``render_dir`` cannot be written.
    """
    background = dataset.background_color
    renders = None if render_dir is None else _Renders(Path(render_dir), len(dataset), tuple(background.tolist()))
    rows: list[dict[str, Any]] = []
    names = distinct_names([entry.name for entry in dataset.entries])
    for index, frame in enumerate(dataset):
        rendered = scene.render(frame.camera, frame.time, background)
        image = rendered.rgb.clamp(0.0, 1.0)
        truth = frame.image.to(image.device).clamp(0.0, 1.0)
        row = _measure(frame, image, rendered.alpha, truth, dataset.covisible(index), lpips)
        rows.append({**row, "name": names[index]})
        if colors is not None or fit_color:
            rows[-1].update(_color_scores(frame, image, truth, colors))
        if renders is not None:
            renders.add(rows[-1], index, frame, image, rendered.alpha, truth)
        if watch is not None:
            watch(index, frame, rendered.alpha)
        if progress is not None:
            progress(index + 1, len(dataset))
    if renders is not None:
        renders.finish()
    means = {name: _mean([row[name] for row in rows if name in row]) for name in ("psnr", "ssim", "lpips")}
    if any("mpsnr" in row for row in rows):
        means["mpsnr"] = _mean([row["mpsnr"] for row in rows if "mpsnr" in row])
    ways = [f"{score}_{way}" for way in ("fitted", "interpolated") for score in ("psnr", "ssim")]
    colored = {name: _mean([row[name] for row in rows]) for name in ways if rows and name in rows[0]}
    return {**means, **_spread_of_psnr(rows), **colored, **summarise(rows), "images": len(rows), "per_image": rows}


def _spread_of_psnr(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    worst = min(rows, key=lambda row: row["psnr"], default={})
    median = statistics.median(row["psnr"] for row in rows) if rows else None
    return {"psnr_median": median, "psnr_worst": worst.get("psnr"), "psnr_worst_time": worst.get("time")}


def metrics_of(
    scene: Scene,
    dataset: Dataset,
    *,
    seconds: float | None = None,
    lpips: Lpips | None = None,
    render_dir: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    colors: FrameColors | None = None,
    fit_color: bool = False,
) -> dict[str, Any]:
    """Make the content of ``metrics.json``: the metrics of ``evaluate``, and a description of scene and data.

    If the data folder has ``ground_truth.npz``, the content includes ``epe`` and ``jitter`` of the motion; if it has
    ``rods.npz``, the fields of ``RodCheck.summary``. Neither is included if the run uses only some of the frames.

    Args:
        seconds: duration of the training, if known.
        colors, fit_color: as for ``evaluate``.

    Raises:
        UserError: ``render_dir`` cannot be written, or the ground truth cannot be read.
    """
    data = scene.settings.get("data", {})
    # The true motion and the rods are those of all frames, at the times of all frames.
    whole = not (data.get("frames") or data.get("only_cameras") or dataset.notes)
    rods = load_rods(dataset.folder, dataset.split, len(dataset)) if whole else None
    check = None if rods is None else RodCheck(rods)
    watch = None if check is None else check.add
    measured = evaluate(
        scene,
        dataset,
        lpips=lpips,
        render_dir=render_dir,
        progress=progress,
        watch=watch,
        colors=colors,
        fit_color=fit_color,
    )
    rows = measured.pop("per_image")
    metrics = {
        **measured,
        "split": dataset.split,
        "step": scene.step,
        "seconds": seconds,
        "gaussians": scene.gaussian_count,
        "control_points": scene.control_point_count,
        "motion": scene.motion_name,
        "device": torch.device(getattr(scene, "device", "cpu")).type,
        "data": str(dataset.folder),
        **{key: data.get(key) for key in ("downscale", "resample")},
        "background": dataset.background,
        **{key: data[key] for key in ("frames", "only_cameras") if data.get(key)},
        "seed": scene.settings.get("seed"),
    }
    truth = load_ground_truth(dataset.folder) if whole else None
    if truth is not None:
        opacities = scene.gaussians_at(float(truth.times[0])).opacities
        metrics.update(score_motion(truth, lambda time: scene.gaussians_at(time).means, opacities)._asdict())
    if check is not None:
        metrics.update(check.summary())
    return {**metrics, "per_image": rows}


def _plain(value: Any) -> Any:
    """Replace infinity (the PSNR of equal images) and NaN by None, because JSON has neither."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_metrics(metrics: dict[str, Any], path: str | Path) -> None:
    """Write metrics as JSON atomically: a reader sees either the old file or the new one.

    Raises:
        UserError: the file cannot be written.
    """
    path = Path(path)
    make_parent(path)
    write_atomically(path, (json.dumps(_plain(metrics), indent=2, allow_nan=False) + "\n").encode())
