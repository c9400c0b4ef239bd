"""Coverage of the subject: where a rendered image is transparent although the true one is not, and the reverse.

A limb that turns transparent hardly changes the mean PSNR, but leaves a connected region of true alpha uncovered.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from torch import Tensor

from ..errors import printable

WINDOW = 3
"""Side in pixels of the windows over which alpha is averaged, so that blur by less is not missing, and within which
averaged alpha counts as covering, so that an edge that is shifted by a pixel is not. A thin structure is still found:
nothing is rendered beside it either."""
REGION_SHARE, REGION_LEVEL = 0.3, 0.05
"""A pixel belongs to a region if more than these are uncovered: a share of its averaged alpha, and averaged alpha."""
LARGE_SHARE, LARGE_PIXELS = 0.005, 8.0
"""Size from which a region is reported: share of the subject, and pixels. In sound images of four D-NeRF scenes at
200 x 200, the largest region has 0.2 %."""


class Region(NamedTuple):
    """A connected region of uncovered alpha."""

    share: float
    """Sum of its uncovered alpha, relative to the sum of the true alpha of the whole image."""
    pixels: float
    """Sum of its uncovered alpha."""
    x: float
    """Column of its centre of mass; pixel centres are at +0.5."""
    y: float
    """Row of its centre of mass."""

    @property
    def large(self) -> bool:
        return self.share >= LARGE_SHARE and self.pixels >= LARGE_PIXELS


class Coverage(NamedTuple):
    """Comparison of two alpha images. Shares are relative to the sum of the true alpha."""

    missing: float
    """Share of the true alpha that the rendered alpha does not cover."""
    extra: float
    """Rendered alpha that the true alpha does not cover."""
    missing_region: Region | None
    """Largest region of missing alpha; None without one."""
    extra_region: Region | None
    """Largest region of extra alpha; None without one."""


def compare_alpha(alpha: Tensor, truth: Tensor, mask: Tensor | None = None) -> Coverage | None:
    """Compare a rendered alpha image with the true one.

    Args:
        alpha: [H, W] float32 in [0, 1].
        truth: the same shape.
        mask: [H, W] bool, True where the truth is known. None: everywhere.

    Returns:
        The coverage; None if the true image shows less than one pixel of the subject.
    """
    rendered, true = (image.detach().cpu().numpy() for image in (alpha, truth))
    inside = np.ones(true.shape, np.float32)
    if mask is not None:
        known = mask.cpu().numpy().astype(np.float32)
        rendered, true = rendered * known, true * known
        inside = 1.0 - _largest_within(1.0 - known, 2 * WINDOW - 1)  # Averages over unknown pixels do not count.
    total = float(true.sum(dtype=np.float64))
    if total < 1.0:
        return None
    missing, missing_region = _uncovered(true, rendered, inside, total)
    extra, extra_region = _uncovered(rendered, true, inside, total)
    return Coverage(missing, extra, missing_region, extra_region)


def _largest_within(image: np.ndarray, side: int) -> np.ndarray:
    """Return the largest value in the window around each pixel of [H, W]."""
    return cv2.dilate(image, np.ones((side, side), np.uint8))


def _average(image: np.ndarray) -> np.ndarray:
    return cv2.blur(image, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT)


def _uncovered(alpha: np.ndarray, cover: np.ndarray, inside: np.ndarray, total: float) -> tuple[float, Region | None]:
    """Return the sum of ``alpha`` [H, W] that ``cover`` does not cover, relative to ``total``, and its largest
    region."""
    averaged = _average(alpha)
    uncovered = np.maximum(averaged - _largest_within(_average(cover), WINDOW), 0.0) * inside
    belongs = (uncovered > REGION_LEVEL) & (uncovered > REGION_SHARE * averaged)
    return float(uncovered.sum(dtype=np.float64)) / total, _largest_region(uncovered, belongs, total)


def _largest_region(uncovered: np.ndarray, belongs: np.ndarray, total: float) -> Region | None:
    """Find the connected region of pixels that ``belongs`` [H, W] marks with the largest sum of uncovered alpha
    [H, W]; None without one."""
    if not belongs.any():
        return None
    _, labels = cv2.connectedComponents(belongs.astype(np.uint8), connectivity=8)
    y, x = np.nonzero(belongs)
    weights, regions = uncovered[y, x].astype(np.float64), labels[y, x]
    sums = np.bincount(regions, weights)
    own = regions == sums.argmax()
    pixels = float(sums.max())
    centre_x, centre_y = (float(np.average(places[own], weights=weights[own])) + 0.5 for places in (x, y))
    return Region(pixels / total, pixels, centre_x, centre_y)


def coverage_row(coverage: Coverage | None) -> dict[str, Any]:
    """Return the entries of one image in ``metrics.json``, which are None without coverage."""
    if coverage is None:
        return dict.fromkeys(Coverage._fields)
    return {key: value._asdict() if isinstance(value, Region) else value for key, value in coverage._asdict().items()}


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Summarise the coverage of a split.

    Args:
        rows: the entries of its images, with ``name`` and ``time``.

    Returns:
        ``missing`` and ``extra``, means over the images that show the subject; ``missing_worst`` and ``extra_worst``,
        the image with the largest region: its ``name``, ``time``, share (``missing`` or ``extra``), ``region``, and
        ``images``, the number of images with a large region. All are None if no image has alpha; the last two also if
        there is no region.
    """
    found: dict[str, Any] = {}
    for kind in ("missing", "extra"):
        own = [row for row in rows if row.get(kind) is not None]
        found[kind] = math.fsum(row[kind] for row in own) / len(own) if own else None
        regions = [(Region(**row[f"{kind}_region"]), row) for row in own if row[f"{kind}_region"] is not None]
        found[f"{kind}_worst"] = None
        if regions:
            region, row = max(regions, key=lambda pair: pair[0].share)
            large = sum(region.large for region, _ in regions)
            view = {"name": row["name"], "time": row["time"], kind: row[kind]}
            found[f"{kind}_worst"] = {**view, "region": region._asdict(), "images": large}
    return found


def coverage_line(metrics: dict[str, Any]) -> str | None:
    """Say in one line where the subject is not covered, or where there is alpha outside it; None if nothing large is.

    Args:
        metrics: content of ``metrics.json``.
    """
    clauses = []
    for kind, head, verb, place in (
        ("missing", "not covered", "misses", "of the subject"),
        ("extra", "outside the subject", "shows", "too much"),
    ):
        worst = metrics.get(f"{kind}_worst")
        if worst is None or worst["images"] == 0:
            continue
        region = worst["region"]
        others = f", and {worst['images'] - 1} more of {metrics['images']} images" if worst["images"] > 1 else ""
        clauses.append(
            f"{head}: {metrics['split']}/{worst['name']} (t = {worst['time']:.2f}) {verb} {100 * worst[kind]:.1f} % "
            f"{place}, largest at x {region['x']:.0f}, y {region['y']:.0f} ({region['pixels']:.0f} px){others}"
        )
    return printable("; ".join(clauses)) or None
