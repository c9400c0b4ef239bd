"""SOG files (PlayCanvas, "spatially ordered Gaussians"): images whose pixels are Gaussians.

``meta.json`` describes the images, which hold a Gaussian per pixel, row by row: ``means_l`` and ``means_u`` the low and
high bytes of positions, as shares of the range of ``sign(x) log(1 + abs(x))``; ``scales`` bytes that index a codebook
of logarithms; ``quats`` the three smaller components (wxyz) and, as alpha, 252 plus the index of the largest; ``sh0``
bytes that index a codebook of coefficients, and opacity as alpha. Harmonics above degree 0 are rows of a palette:
``shN_labels`` holds the row of each Gaussian (16 bits), ``shN_centroids`` the rows, 64 per line of pixels, as bytes
that index a codebook. Positions have the axes of a ``.ply``.

Files without ``version`` are of version 1: ranges take the place of codebooks.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..gaussians import GaussianParameters
from ..geometry.morton import morton_order
from ..storage.json_files import as_array, parse_json
from ..types import Gaussians
from . import smallest_three
from .codebook import LEVELS, encode, make_codebook
from .gaussian_parameters import to_arrays, to_parameters
from .palette import make_palette
from .sog_files import META, REMEDY, SogFiles, encode_image, write_files

VERSION = 2
MAX_GAUSSIANS = 10_000_000
"""Largest number of Gaussians in a file."""
PALETTE_LIMIT = 1 << 16
PALETTE_WIDTH = 64
"""Rows of the palette per line of pixels."""
COUNTS = {1: 3, 2: 8, 3: 15}
"""Numbers of coefficients above degree 0, by degree."""
MOST_VISIBLE, LEAST_AREA = 0.99, 1e-3
"""Quantile of what Gaussians cover that counts as most; least share of it that a Gaussian counts for."""
ORDER_BITS = 21
"""Cells along each axis, as a power of 2, for the order of Gaussians."""
LOG_LIMIT = 40.0
"""Largest magnitude of ``sign(x) log(1 + abs(x))`` that is read."""
ANTIALIASED = "antialiased"
"""Value of ``model`` that marks Gaussians trained with the antialiasing compensation."""


def write_sog(path: str | Path, gaussians: Gaussians, *, antialiased: bool = False) -> None:
    """Write activated Gaussians, world units, in Morton order: one file if the name ends in .sog; if it is meta.json,
    the folder that holds it. The same Gaussians give the same bytes.

    Values are rounded: positions to 1 / 65535 of the range of their logarithms, scales and colours to the nearest of
    256 values chosen for the scene, opacities to 8 bits, rotations to 8 bits a component. Harmonics above degree 0
    become the nearest of at most 65,536 palette rows. Sharp Gaussians are approximated (``Gaussians.plain``).

    Args:
        antialiased: whether the Gaussians were trained with the antialiasing compensation.

    Raises:
        UserError: there are too many Gaussians, the folder holds other files, or it cannot be written.
    """
    path = Path(path)
    rows = to_arrays(gaussians)
    count = len(rows["means"])
    if count > MAX_GAUSSIANS:
        raise UserError(f"{path}: a .sog holds up to {MAX_GAUSSIANS:,} Gaussians, not {count:,}; export a .ply")
    order = morton_order(rows["means"], ORDER_BITS)
    rows = {name: value[order] for name, value in rows.items()}
    width = 4 * math.ceil(math.sqrt(count) / 4)
    size = 4 * math.ceil(count / width / 4), width
    meta, images = _pack(rows, size)
    if antialiased:
        meta["model"] = ANTIALIASED
    files = {f"{name}.webp": encode_image(path, pixels) for name, pixels in images.items()}
    write_files(path, {META: json.dumps(meta, separators=(",", ":")).encode(), **files})


def _pack(rows: dict[str, np.ndarray], size: tuple[int, int]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the description, and the images [H, W, 4] uint8 by name."""
    logs = np.sign(rows["means"]) * np.log1p(np.abs(rows["means"]))
    low, high = logs.min(axis=0), logs.max(axis=0)
    places = np.rint(65535 * (logs - low) / np.where(high > low, high - low, 1.0)).astype(np.uint16)
    largest, others = smallest_three.split(rows["quats"])
    turns = np.rint(255 * (others / (2 * smallest_three.LIMIT) + 0.5)).clip(0, 255)
    scales, colors = make_codebook(rows["log_scales"]), make_codebook(rows["sh_dc"])
    opacity = np.rint(255 * rows["opacities"]).clip(0, 255)
    images = {
        "means_l": _image(places & 255, size),
        "means_u": _image(places >> 8, size),
        "scales": _image(encode(rows["log_scales"], scales), size),
        "quats": _image(np.column_stack([turns, 252 + largest]), size),
        "sh0": _image(np.column_stack([encode(rows["sh_dc"], colors), opacity]), size),
    }
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "scgs_warp"},
        "count": len(places),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _numbers(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _numbers(colors), "files": ["sh0.webp"]},
    }
    coefficients = rows["sh_rest"].shape[1]
    if coefficients:
        rest, most = rows["sh_rest"].reshape(len(places), -1), _palette_size(len(places))
        palette, labels = make_palette(rest, most, _importance(rows))
        book = make_codebook(palette)
        lines = -(-len(palette) // PALETTE_WIDTH)
        codes = encode(palette, book).reshape(-1, 3)
        images["shN_centroids"] = _image(codes, (lines, PALETTE_WIDTH * coefficients))
        images["shN_labels"] = _image(np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)]), size)
        meta["shN"] = {
            "count": len(palette),
            "bands": math.isqrt(coefficients + 1) - 1,
            "codebook": _numbers(book),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    return meta, images


def _palette_size(count: int) -> int:
    """Return the number of palette rows for so many Gaussians: a power of 2, half of them or more, at most 65,536."""
    return min(PALETTE_LIMIT, 1 << (count.bit_length() - 1))


def _importance(rows: dict[str, np.ndarray]) -> np.ndarray:
    """Return how much each Gaussian matters, [N]: the square root of opacity times the area of its largest
    cross-section, relative to that of the most visible, within bounds."""
    area = np.exp(np.sort(rows["log_scales"], axis=1)[:, 1:].sum(axis=1)) * rows["opacities"]
    most = max(float(np.quantile(area, MOST_VISIBLE)), 1e-30)
    return np.sqrt((area / most).clip(LEAST_AREA, 1.0))


def _numbers(book: np.ndarray) -> list[float]:
    return [float(f"{value:.9g}") for value in book]  # all digits of float32


def _image(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return values [N, 3 or 4] as the first pixels of an image [H, W, 4]; alpha is 255 where there is none."""
    pixels = np.zeros((size[0] * size[1], 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(*size, 4)


def read_sog(path: str | Path) -> GaussianParameters:
    """Read raw parameters, world units, from a ``.sog``, from a ``meta.json`` beside its images, or from their folder.
    Versions 1 and 2 are read.

    Raises:
        UserError: a file is missing or damaged, a name leads out of the folder, or no Gaussian is finite.
    """
    files = SogFiles(Path(path))
    meta = _Meta(files)
    count, first = meta.count, meta.version == 1
    low, high = (meta.numbers("means", field, 3) for field in ("mins", "maxs"))
    places = meta.pixels("means", 1)[:, :3].astype(np.uint16) << 8 | meta.pixels("means", 0)[:, :3]
    logs = low + np.where(high > low, high - low, 1.0) * (places / 65535.0)
    turns = meta.pixels("quats", 0)
    named = turns[:, 3] >= 252  # Others are no rotations.
    quats = smallest_three.join(
        np.where(named, turns[:, 3] - 252, 0), (turns[:, :3] / 255.0 - 0.5) * (2 * smallest_three.LIMIT)
    )
    color = meta.pixels("sh0", 0)
    if first:
        logits = meta.book("sh0", 4)[3][color[:, 3]]
    else:
        opacity = (color[:, 3] / 255.0).clip(1e-6, 1.0 - 1e-6)
        logits = np.log(opacity / (1.0 - opacity))
    values = {
        "means": np.sign(logs) * np.expm1(np.abs(logs).clip(0.0, LOG_LIMIT)),
        "sh_dc": _look_up(meta.book("sh0", 4 if first else 1), color[:, :3]),
        "opacity_logits": logits,
        "log_scales": _look_up(meta.book("scales", 3 if first else 1), meta.pixels("scales", 0)[:, :3]),
        "quats": np.where(named[:, None], quats, [1.0, 0.0, 0.0, 0.0]),
        "sh_rest": _rest(meta, files),
    }
    assert len(values["means"]) == count
    return to_parameters(files.path, {name: value.astype(np.float32) for name, value in values.items()})


def _look_up(book: list[np.ndarray], codes: np.ndarray) -> np.ndarray:
    """Return the numbers [N, 3] of codes [N, 3], from one codebook or from one per column."""
    return np.stack([book[column % len(book)][codes[:, column]] for column in range(3)], axis=1)


def _rest(meta: _Meta, files: SogFiles) -> np.ndarray:
    """Return the harmonics above degree 0, [N, K - 1, 3] float32."""
    if meta.section("shN", needed=False) is None:
        return np.zeros((meta.count, 0, 3), np.float32)
    pixels = files.image(meta.file("shN", 0), 1)
    height, width = pixels.shape[:2]
    degree = next((d for d, k in COUNTS.items() if k * PALETTE_WIDTH == width), 0)
    said = meta.section("shN").get("bands", degree)
    rows = meta.section("shN").get("count", height * PALETTE_WIDTH)
    if not degree or said != degree or not isinstance(rows, int) or not 0 < rows <= height * PALETTE_WIDTH:
        what = f"{str(rows)[:20]} rows of degree {str(said)[:20]} in an image of {width} x {height}"
        raise UserError(f"{files.path}: shN has {what}; {REMEDY}")
    palette = meta.book("shN", 1)[0].astype(np.float32)[pixels[..., :3]].reshape(-1, COUNTS[degree], 3)
    low_high = meta.pixels("shN", 1)
    labels = low_high[:, 1].astype(np.int64) << 8 | low_high[:, 0]
    known = labels < rows
    rest = palette[np.where(known, labels, 0)]
    rest[~known] = 0.0
    return rest


class _Meta:
    """Checked access to a description and to the images that it names."""

    def __init__(self, files: SogFiles) -> None:
        self.files, self.where = files, files.path
        try:
            content = parse_json(files.meta())
        except (ValueError, RecursionError):
            raise UserError(f"{self.where}: {META} is not valid JSON; {REMEDY}") from None
        if not isinstance(content, dict):
            raise UserError(f"{self.where}: {META} holds no JSON object; {REMEDY}")
        self.content: dict[str, Any] = content
        self.version = content.get("version", 1)
        if self.version not in (1, VERSION):
            raise UserError(f"{self.where}: version {str(self.version)[:20]} of SOG; 1 and 2 are read: {REMEDY}")
        shape = self.section("means").get("shape")
        count = content.get("count", shape[0] if isinstance(shape, list) and shape else None)
        if isinstance(count, bool) or not isinstance(count, int) or not 0 < count <= MAX_GAUSSIANS:
            raise UserError(f"{self.where}: count is {str(count)[:20]}; give 1 to {MAX_GAUSSIANS:,} Gaussians")
        self.count: int = count

    def section(self, name: str, needed: bool = True) -> Any:
        """Return an object of the description; None if it is missing and not needed."""
        found = self.content.get(name)
        if found is None and not needed:
            return None
        if not isinstance(found, dict):
            raise UserError(f"{self.where}: {name} is missing or no object; {REMEDY}")
        return found

    def numbers(self, name: str, field: str, count: int) -> np.ndarray:
        """Return so many finite numbers."""
        found = self.section(name).get(field)
        values = as_array([found] if count == 1 and not isinstance(found, list) else found, (count,))
        if values is None or np.abs(values).max() > 1e15:
            raise UserError(f"{self.where}: {name}.{field} is not {count} finite numbers; {REMEDY}")
        return values

    def book(self, name: str, columns: int) -> list[np.ndarray]:
        """Return the codebook [256] float64; in version 1, one for each of so many columns, from their ranges."""
        if self.version == 1:
            ranges = (self.numbers(name, field, columns) for field in ("mins", "maxs"))
            return [np.linspace(low, high, LEVELS) for low, high in zip(*ranges)]
        found = self.section(name).get("codebook")
        if isinstance(found, list) and len(found) == LEVELS and found[0] is None:  # a flaw of the first writers
            rest = as_array(found[1:], (LEVELS - 1,))
            found = found if rest is None else [rest[0] - (rest[-1] - rest[0]) / LEVELS, *rest]
        values = as_array(found, *((size,) for size in range(1, LEVELS + 1)))
        if values is None or np.abs(values).max() > 1e15:
            raise UserError(f"{self.where}: {name}.codebook is not 1 to {LEVELS} finite numbers; {REMEDY}")
        return [np.pad(values, (0, LEVELS - len(values)), mode="edge")]

    def file(self, name: str, index: int) -> str:
        """Return the name of an image."""
        files = self.section(name).get("files")
        if not isinstance(files, list) or len(files) <= index or not isinstance(files[index], str):
            raise UserError(f"{self.where}: {name}.files names no image number {index + 1}; {REMEDY}")
        return files[index]

    def pixels(self, name: str, index: int) -> np.ndarray:
        """Return the pixels of all Gaussians in an image, [N, 4] uint8."""
        return self.files.image(self.file(name, index), self.count).reshape(-1, 4)[: self.count]


def read_antialiased_model(path: Path) -> bool:
    """Return whether a SOG is marked as trained with the antialiasing compensation; False if it is damaged."""
    try:
        content = parse_json(SogFiles(path).meta())
    except (UserError, ValueError):
        return False  # The reader of the Gaussians reports the damage.
    return isinstance(content, dict) and content.get("model") == ANTIALIASED
