// Search for the nearest control points ("nodes") on CUDA: a point per thread, 256 points per block.
#pragma once

static inline __device__ void nearest_of_block(
    int block, const wp::array_t<float>& points, const wp::array_t<float>& nodes, int K, wp::array_t<int>& indices,
    wp::array_t<float>& distances
) {
    struct One {
        enum { value = 1 };
    };
    struct Two {
        enum { value = 2 };
    };
    struct Three {
        enum { value = 3 };
    };
    __shared__ float4 staged[256 * 3];
    const int thread = threadIdx.x, i = 256 * block + thread;
    const int count = nodes.shape.dims[0], dimensions = points.shape.dims[1];
    const bool inside = i < points.shape.dims[0];
    auto search = [&](auto quads) {
        constexpr int QUADS = decltype(quads)::value;
        // Dimensions beyond the last are zero in points and nodes, and add zero to the distance.
        auto value = [&](const float* row, int d) { return d < dimensions ? row[d] : 0.0f; };
        float own[4 * QUADS];
#pragma unroll
        for (int d = 0; d < 4 * QUADS; ++d) own[d] = inside ? value(points.data + (long long)i * dimensions, d) : 0.0f;
        float best[4] = {INFINITY, INFINITY, INFINITY, INFINITY};
        int at[4] = {0, 1, 2, 3};
        for (int first = 0; first < count; first += 256) {
            const int size = count - first < 256 ? count - first : 256;
            __syncthreads();  // no thread reads the previous nodes any more
            if (thread < size) {
                const float* node = nodes.data + (long long)(first + thread) * dimensions;
#pragma unroll
                for (int q = 0; q < QUADS; ++q)
                    staged[thread * QUADS + q] = make_float4(
                        value(node, 4 * q), value(node, 4 * q + 1), value(node, 4 * q + 2), value(node, 4 * q + 3)
                    );
            }
            __syncthreads();
#pragma unroll 4
            for (int m = 0; m < size; ++m) {
                float squared = 0.0f;
#pragma unroll
                for (int q = 0; q < QUADS; ++q) {
                    const float4 node = staged[m * QUADS + q];
                    const float x = own[4 * q] - node.x, y = own[4 * q + 1] - node.y;
                    const float z = own[4 * q + 2] - node.z, w = own[4 * q + 3] - node.w;
                    squared = fmaf(w, w, fmaf(z, z, fmaf(y, y, fmaf(x, x, squared))));
                }
                if (squared < best[3]) {
#pragma unroll
                    for (int j = 3; j > 0; --j) {  // entries that are farther move on by one
                        const bool before = squared < best[j - 1];
                        at[j] = before ? at[j - 1] : (squared < best[j] ? first + m : at[j]);
                        best[j] = before ? best[j - 1] : fminf(squared, best[j]);
                    }
                    at[0] = squared < best[0] ? first + m : at[0];
                    best[0] = fminf(squared, best[0]);
                }
            }
        }
#pragma unroll
        for (int j = 0; j < 4; ++j)
            if (inside && j < K) {
                indices.data[(long long)i * K + j] = at[j];
                distances.data[(long long)i * K + j] = best[j];
            }
    };
    if (dimensions <= 4)
        search(One());
    else if (dimensions <= 8)
        search(Two());
    else
        search(Three());
}
