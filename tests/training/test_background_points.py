"""Initial points behind the known ones: on rays of valid pixels, from all frames."""

from __future__ import annotations

import pytest
import torch

from helpers.tiny import blobs, tiny_camera
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.rendering.render import render
from scgs_warp.training.background_points import FARTHEST, background_points
from scgs_warp.types import Camera, Frame


def masked_frames(count: int) -> list[Frame]:
    """Each of another tint; the left half of each is not valid."""
    frames = []
    for index in range(count):
        camera = tiny_camera(index, count, 32)
        image = render(blobs(0.0), camera, torch.full((3,), (index + 1) / count)).rgb
        mask = torch.ones(32, 32, dtype=torch.bool)
        mask[:, :16] = False
        frames.append(Frame(camera, 0.0, image, mask=mask))
    return frames


def seen_by(
    frame: Frame, points: torch.Tensor, colors: torch.Tensor, known: torch.Tensor, normalisation: Normalisation
):
    """[B] whether each point may be one of this frame's: on a valid pixel of its colour, behind the known points."""
    camera = normalisation.apply_camera(frame.camera)
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
    inside = ((pixels >= 0) & (pixels < 32)).all(1) & (local[:, 2] > 0)
    columns, rows = pixels.floor().long().clamp(0, 31).unbind(1)
    depths = known @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    between = (local[:, 2] > 0.999 * depths.min()) & (local[:, 2] < 1.001 * FARTHEST * depths.max())
    assert frame.mask is not None
    return inside & frame.mask[rows, columns] & (frame.image[rows, columns] == colors).all(1) & between


@pytest.mark.parametrize("seed", range(3))
def test_backdrop_lies_on_rays_behind_the_points(seed):
    frames = masked_frames(5)
    normalisation = Normalisation.fit([frame.camera for frame in frames])
    known = normalisation.apply(blobs(0.0).means)
    found, colors = background_points(43, known, frames, normalisation, seed)
    assert found.shape == colors.shape == (43, 3)
    owned = torch.stack([seen_by(frame, found, colors, known, normalisation) for frame in frames])
    assert owned.any(0).all() and (owned.sum(1) >= 43 // 5).all()
    assert owned[:, :15].any(1).all(), "the first of them come from all frames"
    again = background_points(43, known, frames, normalisation, seed)
    other = background_points(43, known, frames, normalisation, 9)
    assert torch.equal(found, again[0]) and not torch.equal(found, other[0])


def test_a_frame_without_a_valid_pixel_adds_nothing_to_the_background_points():
    frames = masked_frames(4)
    assert frames[1].mask is not None
    frames[1].mask[:] = False
    normalisation = Normalisation.fit([frame.camera for frame in frames])
    known = normalisation.apply(blobs(0.0).means)
    assert len(background_points(40, known, frames, normalisation, 0)[0]) == 30
    assert len(background_points(40, known, frames[1:2], normalisation, 0)[0]) == 0


def test_backdrop_of_images_beyond_2_to_the_24_pixels():
    size = 4100
    K = torch.tensor([[1.4 * size, 0, size / 2], [0, 1.4 * size, size / 2], [0, 0, 1]])
    camera = Camera(tiny_camera(0, 1, 32).viewmat, K, size, size)
    frame = Frame(camera, 0.0, torch.full((1, 1, 3), 0.3).expand(size, size, 3))
    normalisation = Normalisation.fit([camera])
    found, colors = background_points(50, normalisation.apply(blobs(0.0).means), [frame], normalisation, 0)
    assert len(found) == 50 and (colors == 0.3).all()
