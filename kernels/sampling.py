"""Farthest-point sampling: a well-spread subset of a point cloud, the same on every run."""

import warp as wp

wp.set_module_options({"enable_backward": False})

CHOSEN = wp.constant(-1.0)
NOT_FINITE = wp.constant(-0.5)
"""Distances that mark two kinds of points: those already chosen, and non-finite ones, which are chosen last."""


@wp.kernel
def start_distances(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D]
    # Out:
    distances_out: wp.array[float],  # [N]
):
    """Set infinite distances; mark points with non-finite coordinates. Grid: N."""
    i = first + wp.tid()
    distance = float(wp.inf)
    for d in range(points_in.shape[1]):
        if not wp.isfinite(points_in[i, d]):
            distance = NOT_FINITE
    distances_out[i] = distance


@wp.kernel
def farthest_step(
    first: int,
    # In:
    step: int,
    size: int,  # points per chunk
    points_in: wp.array2d[float],  # [N, D]
    best_in: wp.array[float],  # [chunks] greatest distance in each chunk, from the step before
    best_index_in: wp.array[wp.int32],  # [chunks] point with that distance
    # Out:
    distances_out: wp.array[float],  # [N] squared, to the points chosen so far; updated
    best_out: wp.array[float],  # [chunks]
    best_index_out: wp.array[wp.int32],  # [chunks]
    chosen_out: wp.array[wp.int64],  # [count]
):
    """Choose the farthest point, then update a chunk's distances to it. Grid: chunks.

    Every chunk finds the farthest point itself, from the same numbers, so that one launch does both steps.
    """
    chunk = first + wp.tid()
    chosen = int(best_index_in[0])
    farthest = float(best_in[0])
    for c in range(1, best_in.shape[0]):
        if best_in[c] > farthest:
            farthest = best_in[c]
            chosen = best_index_in[c]
    if chunk == 0:
        chosen_out[step] = wp.int64(chosen)
    best = float(-wp.inf)
    best_index = int(0)
    for i in range(chunk * size, wp.min((chunk + 1) * size, points_in.shape[0])):
        d2 = float(0.0)
        for d in range(points_in.shape[1]):
            e = points_in[i, d] - points_in[chosen, d]
            d2 += e * e
        distance = distances_out[i]
        if i == chosen:
            distance = CHOSEN
            distances_out[i] = distance
        elif d2 < distance:
            distance = d2
            distances_out[i] = distance
        if distance > best:
            best = distance
            best_index = i
    best_out[chunk] = best
    best_index_out[chunk] = best_index
