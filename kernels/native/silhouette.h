// Distances between spheres and a silhouette, 16 spheres or pixels at a time, by the formulas of kernels/silhouette.py.
#pragma once
#include "columns.h"

// Positions of 16 spheres in the camera's frame, and the depths by which they are divided.
struct SeenSpheres {
    vf local[3], depth;
    vi limited;

    __attribute__((always_inline)) SeenSpheres(const void* means, int begin, int rows, const float* view) {
        NO_FUSING
        vf mean[3];
        read_vectors(means, begin, rows, 3, mean);
        for (int r = 0; r < 3; ++r) {
            const float* row = view + 4 * r;
            local[r] = mean[0] * row[0] + mean[1] * row[1] + mean[2] * row[2] + row[3];
        }
        limited = local[2] < SILHOUETTE_NEAREST_DEPTH;
        depth = limited ? vf{} + SILHOUETTE_NEAREST_DEPTH : local[2];
    }

    // Return a pixel coordinate, by a row of K.
    __attribute__((always_inline)) vf in_image(const float* row) const {
        NO_FUSING
        return (local[0] * row[0] + local[1] * row[1] + local[2] * row[2]) / depth;
    }
};

// Places of 16 coordinates in the table, along one of its axes.
struct TablePlaces {
    vf part;  // of the way to the next sample
    vi at, inside;
    float scale;  // samples per unit of length

    __attribute__((always_inline)) TablePlaces(vf coordinate, float size, int count) {
        NO_FUSING
        const float last = (float)(count - 1);
        const vf index = coordinate / size * (float)count - 0.5f;
        const vf above = index > 0.0f ? index : vf{};  // 0 for NaN
        const vf within = above < last ? above : vf{} + last;
        at = __builtin_convertvector(within, vi);
        part = within - __builtin_convertvector(at, vf);
        inside = (index > 0.0f) & (index < last);
        scale = (float)count / size;
    }
};

// Project the centres of spheres begin to begin + 15, and sample the table there.
static inline void project_spheres(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::mat44>& viewmat,
    const wp::array_t<wp::mat33>& intrinsics, int width, const wp::array_t<float>& distances,
    const wp::array_t<float>& size, wp::array_t<wp::vec2>& points, wp::array_t<wp::vec2>& slopes,
    wp::array_t<float>& parts
) {
    NO_FUSING
    const int N = means.shape[0], n = N - begin < 16 ? N - begin : 16;
    const int rows = distances.shape[0], columns = distances.shape[1];
    const float* K = (const float*)intrinsics.data;
    const SeenSpheres seen(means.data, begin, n, (const float*)viewmat.data);
    vf point[2], slope[2];
    for (int c = 0; c < 2; ++c) point[c] = seen.in_image(K + 3 * c) / (float)width;
    const TablePlaces x(point[0], size.data[0], columns), y(point[1], size.data[1], rows);
    vf corners[4];
    for (int lane = 0; lane < 16; ++lane) {
        const float* corner = distances.data + (long long)y.at[lane] * columns + x.at[lane];
        const int right = x.at[lane] < columns - 1, down = y.at[lane] < rows - 1 ? columns : 0;
        corners[0][lane] = corner[0];
        corners[1][lane] = corner[right];
        corners[2][lane] = corner[down];
        corners[3][lane] = corner[down + right];
    }
    const vf a = x.part, b = y.part;
    const vf upper = (1.0f - a) * corners[0] + a * corners[1];
    const vf lower = (1.0f - a) * corners[2] + a * corners[3];
    const vf along_x = (1.0f - b) * (corners[1] - corners[0]) + b * (corners[3] - corners[2]);
    const vf strayed = (1.0f - b) * upper + b * lower;
    const vi known = (point[0] == point[0]) & (point[1] == point[1]);
    slope[0] = x.inside ? along_x * x.scale : vf{};
    slope[1] = y.inside ? (lower - upper) * y.scale : vf{};
    write_vectors(points.data, begin, n, 2, point);
    write_vectors(slopes.data, begin, n, 2, slope);
    store(parts.data + begin, (known ? strayed : point[0] + point[1]) / (float)N, n);
}

// Find the projected centres that are nearest to pixels begin to begin + 15.
static inline void nearest_spheres(
    int begin, const wp::array_t<wp::vec2>& points, const wp::array_t<wp::vec2>& pixels, wp::array_t<int>& indices,
    wp::array_t<wp::vec2>& directions, wp::array_t<float>& parts
) {
    NO_FUSING
    const int N = points.shape[0], P = pixels.shape[0], n = P - begin < 16 ? P - begin : 16;
    const float* point = (const float*)points.data;
    vf pixel[2], nearest[2], least = vf{} + __builtin_inff();
    vi index = {};
    read_vectors(pixels.data, begin, n, 2, pixel);
    for (int i = 0; i < N; ++i) {
        const vf x = point[2 * i] - pixel[0], y = point[2 * i + 1] - pixel[1];
        const vf squared = x * x + y * y;
        const vi nearer = squared < least;
        least = nearer ? squared : least;
        index = nearer ? vi{} + i : index;
    }
    const vf distance = __builtin_elementwise_sqrt(least);
    for (int c = 0; c < 2; ++c) {
        for (int lane = 0; lane < 16; ++lane) nearest[c][lane] = point[2 * index[lane] + c];
        nearest[c] = distance > 0.0f ? (nearest[c] - pixel[c]) / distance : vf{};
    }
    __builtin_memcpy(indices.data + begin, &index, 4 * n);
    write_vectors(directions.data, begin, n, 2, nearest);
    store(parts.data + N + begin, distance / (float)P, n);
}

// Compute the gradients of the centres of spheres begin to begin + 15.
static inline void project_spheres_adjoint(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::mat44>& viewmat,
    const wp::array_t<wp::mat33>& intrinsics, int width, const wp::array_t<wp::vec2>& slopes,
    const wp::array_t<int>& indices, const wp::array_t<wp::vec2>& directions, const wp::array_t<float>& v_term,
    wp::array_t<wp::vec3>& v_means
) {
    NO_FUSING
    const int N = means.shape[0], P = indices.shape[0], n = N - begin < 16 ? N - begin : 16;
    const float *view = (const float*)viewmat.data, *K = (const float*)intrinsics.data;
    // Pixels in ascending order, of which few are nearest to one of these spheres.
    const float* direction = (const float*)directions.data;
    vf pull[2] = {}, slope[2], v[2], v_local[3], v_mean[3];
    for (int p = 0; p < P; p += 16) {
        const int some = P - p < 16 ? P - p : 16;
        vi own = vi{} - 1;
        __builtin_memcpy(&own, indices.data + p, 4 * some);
        own = own - begin;
        for (unsigned found = bits((own >= 0) & (own < n)); found; found &= found - 1) {
            const int k = __builtin_ctz(found);
            for (int c = 0; c < 2; ++c) pull[c][own[k]] += direction[2 * (p + k) + c];
        }
    }
    read_vectors(slopes.data, begin, n, 2, slope);
    const SeenSpheres seen(means.data, begin, n, view);
    vf v_depth = {};
    for (int c = 0; c < 2; ++c) {
        v[c] = v_term.data[0] * (slope[c] / (float)N + pull[c] / (float)P) / (float)width / seen.depth;
        v_depth = c ? -(v_depth + v[c] * seen.in_image(K + 3)) : v[c] * seen.in_image(K);
    }
    for (int c = 0; c < 3; ++c) v_local[c] = v[0] * K[c] + v[1] * K[3 + c];
    v_local[2] = v_local[2] + (seen.limited ? vf{} : v_depth);
    for (int c = 0; c < 3; ++c) v_mean[c] = v_local[0] * view[c] + v_local[1] * view[4 + c] + v_local[2] * view[8 + c];
    write_vectors(v_means.data, begin, n, 3, v_mean);
}
