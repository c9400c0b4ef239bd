"""Lenses of a rig: distortion is kept where it explains the picture, and dropped where the pictures hardly tell it."""

from __future__ import annotations

import numpy as np
import pytest

from scgs_warp.capture.colmap import quiet
from scgs_warp.capture.rig.cameras import straightened

FOCAL, WIDTH, HEIGHT = 1000.0, 1200, 1200


def solved(distortion: float, strays: float = 0.0):
    """Make a rig of six cameras with lenses of a distortion, adjusted to pictures of which a share errs widely."""
    with quiet() as pycolmap:
        pycolmap.set_random_seed(3)
        options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=6, num_points3D=600)
        options.camera_width, options.camera_height = WIDTH, HEIGHT
        options.camera_params = [FOCAL, WIDTH / 2, HEIGHT / 2, distortion]
        model = pycolmap.synthesize_dataset(options)
        noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3)
        pycolmap.synthesize_noise(noise, model)
        random = np.random.default_rng(0)
        for seen in (point for image in model.images.values() for point in image.points2D):
            if random.random() < strays:
                seen.xy = seen.xy + random.normal(0.0, 2.5, 2)
        adjustment = pycolmap.BundleAdjustmentOptions()
        adjustment.print_summary = False
        pycolmap.bundle_adjustment(model, adjustment)
        model.update_point_3d_errors()
    return model


def lens_of(model) -> list[float]:
    return [float(value) for value in next(iter(model.cameras.values())).params]


def test_a_distortion_that_explains_nothing_is_dropped():
    """The lens is straight; noise alone has bent it."""
    model = solved(0.0)
    assert lens_of(model)[3] != 0.0
    focal, x, y, distortion = lens_of(straightened(model))
    assert distortion == 0.0 and (x, y) == (WIDTH / 2, HEIGHT / 2)
    assert focal == pytest.approx(FOCAL, rel=0.02)


@pytest.mark.parametrize(("distortion", "strays"), [(-0.8, 0.0), (0.1, 0.0), (0.1, 0.1)])
def test_a_real_distortion_is_kept(distortion, strays):
    model = solved(distortion, strays)
    kept = straightened(model)
    assert lens_of(kept)[3] == pytest.approx(distortion, abs=0.05) and lens_of(kept)[0] == pytest.approx(
        FOCAL, rel=0.02
    )


def test_the_model_itself_is_not_changed():
    model = solved(0.0)
    before = lens_of(model)
    straightened(model)
    assert lens_of(model) == before
