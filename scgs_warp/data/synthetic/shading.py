"""Settings of the light on a synthetic subject."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Shading:
    """Settings of light, diffuse shading and the backs of surfaces."""

    light: tuple[float, float, float] = (-0.42, -0.62, 0.66)
    """Direction to the light, world (z up, the subject faces -y)."""
    ambient: float = 0.5
    diffuse: float = 0.5
    """Factors of the ambient and of the diffuse light.

    A glTF surface receives ambient x (0.75 .. 1, more from above) + diffuse x cosine, in linear light. Built-in
    subjects have coloured light and shadows; their two lights are scaled by these factors over 0.5.
    """
    unlit: bool = False
    """Show base colours without shading."""
    two_sided: bool = False
    """Show the backs of all surfaces, also of those that a glTF file shows from one side only."""
