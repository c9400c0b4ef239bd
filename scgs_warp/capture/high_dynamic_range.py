"""Films of high dynamic range as standard ones: phones record HLG, other cameras also PQ (ITU-R BT.2100).

Shown as they are stored, such pictures are grey. White paper becomes nearly white; what is left shows highlights.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np

HLG, PQ = 18, 16
"""Numbers of the transfer functions (ITU-T H.273)."""
PAPER_NITS = 203.0
"""Brightness of white paper, cd/m2 (ITU-R BT.2408)."""
HLG_NITS, HLG_GAMMA = 1000.0, 1.2
"""Nominal peak of HLG, and its system gamma."""
KNEE = 0.7
"""Linear brightness, as a share of white paper's, from which highlights are compressed."""
LUMINANCE = np.array([[0.2627, 0.6780, 0.0593]], np.float32)
"""Of the primaries of BT.2020."""
TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)  # fmt: skip
"""Linear BT.2020 to linear BT.709 (ITU-R BT.2087)."""


def is_high_dynamic_range(transfer: int) -> bool:
    """Return whether a film of this transfer function has a high dynamic range."""
    return transfer in (HLG, PQ)


def to_standard(image: np.ndarray, transfer: int) -> np.ndarray:
    """Convert a picture [H, W, 3] uint16 of BT.2020 to sRGB [H, W, 3] uint8."""
    light = _light(transfer)[image]
    if transfer == HLG:
        luminance = np.maximum(cv2.transform(light, LUMINANCE), 1e-6)
        light = light * luminance[..., None] ** np.float32(HLG_GAMMA - 1.0) * np.float32(HLG_NITS / PAPER_NITS)
    light = np.maximum(cv2.transform(light, TO_BT709), 0.0)
    over = np.maximum(light - KNEE, 0.0) / (1.0 - KNEE)
    light = np.minimum(light, KNEE) + (1.0 - KNEE) * -np.expm1(-over)
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * signal).astype(np.uint8)


@functools.cache
def _light(transfer: int) -> np.ndarray:
    """Return the light of all signals [65536]: of HLG that of the scene from 0 to 1, of PQ that of the screen as a
    share of white paper's."""
    signal = np.linspace(0.0, 1.0, 1 << 16)
    if transfer == HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)
    else:
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        root = signal ** (1.0 / m2)
        light = 10_000.0 / PAPER_NITS * (np.maximum(root - c1, 0.0) / (c2 - c3 * root)) ** (1.0 / m1)
    return light.astype(np.float32)
