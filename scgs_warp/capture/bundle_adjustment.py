"""Robust bundle adjustment: moving objects and wrong matches hardly shift the cameras.

COLMAP's mapper sums squared errors of all observations that it accepts. If a mover fills a good part of a frame and
moves along its epipolar lines, the mapper accepts the mover's features, and these shift the camera. A Cauchy loss
limits the influence of observations that fit badly. The result is used only if it moves some cameras far more than
their neighbours. If it moves all cameras alike, nothing shows that the mapper's cameras were worse, and a film of a
hand scored higher with the mapper's cameras.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .colmap import quiet, read_model, write_model
from .similarity import align

ROBUST = 0.5
"""Reprojection error, pixels, beyond which an observation pulls less and less."""
ROUNDS, ITERATIONS = 3, 8
"""Number of solutions, between which strays are removed, and of iterations of each. More hardly change the cameras."""
NEIGHBOURS = 4
"""Number of cameras before and after one with whose shift its own is compared."""
PULLED = 10.0
"""Ratio of the largest to the median such difference above which cameras were pulled off."""
STRAY, STRAY_FACTOR = 2.0, 6.0
"""Reprojection error, pixels, and factor on the median error, above both of which an observation is removed."""


def adjust_model(source: Path, target: Path, done: Callable[[], object]) -> bool:
    """Adjust the model in a folder, without strays, and write it to another folder; write it as it was if no camera was
    pulled off.

    Args:
        done: called after each of ``ROUNDS``.

    Returns:
        Whether the adjusted model was written.

    Raises:
        UserError: the model is damaged, or cannot be written.
    """
    model = read_model(source)
    for index in range(ROUNDS):
        if index:
            _remove_strays(model)
        adjust(model, distortion=True, iterations=ITERATIONS)
        done()
    mapped = read_model(source)
    pulled = were_pulled(_centres(mapped), _centres(model))
    write_model(model if pulled else mapped, target)
    return pulled


def were_pulled(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether some of the camera centres [V, 3], in the order of the frames, moved far more than those beside
    them."""
    shifts, count = align(before, after).points(before) - after, len(after)
    around = [
        np.median(np.delete(shifts[max(k - NEIGHBOURS, 0) : k + NEIGHBOURS + 1], min(k, NEIGHBOURS), axis=0), axis=0)
        for k in range(count)
    ]
    apart = np.linalg.norm(shifts - np.stack(around), axis=1)
    return bool(apart.max() > PULLED * np.median(apart))


def _centres(model: Any) -> np.ndarray:
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    return np.stack([image.projection_center() for image in images])


def adjust(model: Any, distortion: bool, iterations: int | None = None) -> float:
    """Adjust cameras and points of a COLMAP reconstruction in place, on one thread, and return the median error.

    Args:
        distortion: whether the lens' distortion is adjusted, too.
        iterations: largest number; None: as many as it takes, at most COLMAP's.
    """
    if not model.points3D:
        return 0.0
    with quiet() as pycolmap:
        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary, options.refine_extra_params = False, distortion
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = ROBUST
        options.ceres.solver_options.num_threads = 1
        if iterations is not None:
            options.ceres.solver_options.max_num_iterations = iterations
        # pycolmap.bundle_adjustment would write to the user's terminal.
        config = pycolmap.BundleAdjustmentConfig()
        for image in model.reg_image_ids():
            config.add_image(image)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return median_error(model)


def median_error(model: Any) -> float:
    """Return the median over a model's points of the mean reprojection error, pixels; strays would dominate a mean."""
    model.update_point_3d_errors()
    return float(np.median([point.error for point in model.points3D.values()])) if model.points3D else 0.0


def _remove_strays(model: Any) -> None:
    limit = max(STRAY, STRAY_FACTOR * median_error(model))
    with quiet() as pycolmap:
        observations = pycolmap.ObservationManager(model)
        observations.filter_points3D_with_large_reprojection_error(limit, set(model.points3D))
        observations.filter_observations_with_negative_depth()
    model.update_point_3d_errors()
