// Colours from spherical harmonics on CUDA, and their adjoint: 128 Gaussians per block of 256 threads.
//
// A Gaussian's coefficients are a row of up to 192 bytes. All threads of a block copy its rows between global and
// shared memory, neighbouring threads neighbouring addresses; half of them then compute, each from a row of its own.
#pragma once

enum {
    GAUSSIANS = 128,
    COLUMNS = 48,  // the longest row that is used: 16 triples
    QUADS = 3,     // copies of 16 bytes that a thread has under way at once
    LINES = 4,     // rows of which a thread copies 4 or 8 bytes at once
    SHIFT = 20,    // of the factors that replace divisions: exact, for 128 rows of at most 45 floats
};

// Rows of a block's Gaussians in global memory, and as staged in shared memory.
struct Rows {
    int n;            // number of Gaussians
    int row;          // length of a row, in floats
    int used;         // number of floats that are read, from a row's first on
    int kept;         // number of floats that are staged; the others are written as zeros
    int pitch;        // length of a staged row: odd, so that threads that read different rows read different banks
    long long first;  // index of the first row's first float

    __device__ Rows(int block, int total, int row, int used, int most) : row(row), used(used) {
        const int begin = block * GAUSSIANS;
        n = total - begin < GAUSSIANS ? total - begin : GAUSSIANS;
        first = (long long)begin * row;
        kept = row <= most ? row : used;
        pitch = kept | 1;
    }

    // Return whether memory holds the rows as they are staged, and at an address for copies of 16 bytes.
    __device__ bool same_layout(const float* data) const {
        return pitch == row && ((unsigned long long)data & 15) == 0;
    }

    // Stage the used part of the rows; ``alive`` is null, or says which rows are wanted.
    __device__ void load(float* staged, const float* data, const int* alive) const {
        const float* from = data + first;
        if (used == row && same_layout(from))
            load_quads(staged, from, alive);
        else if (used > 0)
            load_lines(staged, from, alive);
    }

    // Write the staged rows.
    __device__ void store(const float* staged, float* data) const {
        float* to = data + first;
        if (same_layout(to))
            store_quads(staged, to);
        else
            store_lines(staged, to);
    }

    __device__ void load_quads(float* staged, const float* from, const int* alive) const {
        const int thread = threadIdx.x, quads = n * row / 4, last = 4 * quads + thread;
        const int inverse = (1 << SHIFT) / row + 1;
#pragma unroll 1
        for (int begin = thread; begin < quads; begin += QUADS * 256) {
            float4 held[QUADS];
            bool wanted[QUADS];
#pragma unroll
            for (int j = 0; j < QUADS; ++j) {
                const int k = begin + 256 * j;
                wanted[j] = k < quads;
                if (alive && wanted[j])  // a quad may lie in two rows
                    wanted[j] = alive[4 * k * inverse >> SHIFT] | alive[(4 * k + 3) * inverse >> SHIFT];
                held[j] = wanted[j] ? ((const float4*)from)[k] : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
            }
#pragma unroll
            for (int j = 0; j < QUADS; ++j)
                if (wanted[j]) ((float4*)staged)[begin + 256 * j] = held[j];
        }
        if (last < n * row) staged[last] = from[last];
    }

    __device__ void store_quads(const float* staged, float* to) const {
        const int thread = threadIdx.x, quads = n * row / 4, last = 4 * quads + thread;
#pragma unroll 2
        for (int k = thread; k < quads; k += 256) ((float4*)to)[k] = ((const float4*)staged)[k];
        if (last < n * row) to[last] = staged[last];
    }

    // A warp per row; a row's used part has at most 64 floats.
    __device__ void load_lines(float* staged, const float* from, const int* alive) const {
        const int lane = threadIdx.x & 31;
#pragma unroll 1
        for (int begin = threadIdx.x >> 5; begin < n; begin += LINES * 8) {
            float held[LINES][2];
            bool wanted[LINES];
#pragma unroll
            for (int j = 0; j < LINES; ++j) {
                const int k = begin + 8 * j;
                wanted[j] = k < n && (!alive || alive[k]);
                for (int h = 0; h < 2; ++h)
                    held[j][h] = wanted[j] && lane + 32 * h < used ? from[k * row + lane + 32 * h] : 0.0f;
            }
#pragma unroll
            for (int j = 0; j < LINES; ++j) {
                float* to = staged + (begin + 8 * j) * pitch + lane;
                for (int h = 0; h < 2; ++h)
                    if (wanted[j] && lane + 32 * h < used) to[32 * h] = held[j][h];
            }
        }
    }

    __device__ void store_lines(const float* staged, float* to) const {
        const int lane = threadIdx.x & 31;
#pragma unroll 2
        for (int k = threadIdx.x >> 5; k < n; k += 8)
#pragma unroll 2
            for (int column = lane; column < row; column += 32)
                to[k * row + column] = column < kept ? staged[k * pitch + column] : 0.0f;
    }
};

static inline __device__ Rows triples_of(int block, int total) { return Rows(block, total, 3, 3, 3); }

// Return the rows of coefficients of which ``begin`` triples, those of degree 0, stand before the higher ones.
static inline __device__ Rows coefficients_of(int block, int total, int row, int begin, int degree) {
    return Rows(block, total, 3 * row, 3 * (begin + (degree + 1) * (degree + 1) - 1), COLUMNS - 3 + 3 * begin);
}

// Compute the unit direction ``d`` from the camera, and 1 / distance; both are 0 where the distance is 0 or non-finite.
static inline __device__ float view_ray(const float* mean, const float* camera, float* d) {
    const float offset[3] = {mean[0] - camera[0], mean[1] - camera[1], mean[2] - camera[2]};
    const float squared = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2];
    const bool seen = squared > 0.0f && squared < INFINITY;
    const float inverse = seen ? 1.0f / sqrtf(squared) : 0.0f;
    for (int a = 0; a < 3; ++a) d[a] = seen ? inverse * offset[a] : 0.0f;
    return inverse;
}

// Return a function that calls ``use(k, value)`` for the basis functions of degree 1 to ``degree``.
static inline __device__ auto each_basis() {
    return [](const float* d, int degree, auto use) {
        const float x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
        if (degree < 1) return;
        use(0, -SH_C1 * y);
        use(1, SH_C1 * z);
        use(2, -SH_C1 * x);
        if (degree < 2) return;
        use(3, SH_C2 * x * y);
        use(4, -SH_C2 * y * z);
        use(5, SH_C20 * (3.0f * zz - 1.0f));
        use(6, -SH_C2 * x * z);
        use(7, SH_C22 * (xx - yy));
        if (degree < 3) return;
        use(8, SH_C33 * y * (yy - 3.0f * xx));
        use(9, SH_C32 * x * y * z);
        use(10, SH_C31 * y * (1.0f - 5.0f * zz));
        use(11, SH_C30 * z * (5.0f * zz - 3.0f));
        use(12, SH_C31 * x * (1.0f - 5.0f * zz));
        use(13, SH_C3Z * z * (xx - yy));
        use(14, SH_C33 * x * (3.0f * yy - xx));
    };
}

// Compute a Gaussian's colour from its coefficients: >= 0, or non-finite where one of them is.
static inline __device__ void color_of(
    const float* dc, const float* rest, const float* mean, const float* camera, int degree, float* color
) {
    float d[3];
    view_ray(mean, camera, d);
    for (int c = 0; c < 3; ++c) color[c] = SH_C0 * dc[c] + 0.5f;
    each_basis()(d, degree, [&](int k, float value) {
        for (int c = 0; c < 3; ++c) color[c] += value * rest[3 * k + c];
    });
    for (int c = 0; c < 3; ++c) color[c] = color[c] > 0.0f ? color[c] : color[c] - color[c];  // 0, or NaN for NaN
}

// Return a function that computes the colours of a block; ``finish(lane, i, color)`` is called by each Gaussian's
// thread.
static inline __device__ auto each_color() {
    return [](int block, const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<wp::vec3>& sh_rest, int rest_row,
              int rest_begin, const wp::array_t<wp::vec3>& means, const float* camera, int degree, auto finish) {
        __shared__ float4 memory[GAUSSIANS * (COLUMNS + 1) / 4];
        float *staged = (float*)memory, dc[3], mean[3], color[3];
        const Rows rows = coefficients_of(block, means.shape.dims[0], rest_row, rest_begin, degree);
        const int lane = threadIdx.x;
        const long long i = (long long)block * GAUSSIANS + lane;
        if (lane < rows.n)
            for (int c = 0; c < 3; ++c) {
                mean[c] = ((const float*)means.data)[3 * i + c];
                dc[c] = rest_begin ? 0.0f : ((const float*)sh_dc.data)[3 * i + c];
            }
        rows.load(staged, (const float*)sh_rest.data, nullptr);
        __syncthreads();
        if (lane >= rows.n) return;
        const float* own = staged + lane * rows.pitch;
        if (rest_begin)
            for (int c = 0; c < 3; ++c) dc[c] = own[c];
        color_of(dc, own + 3 * rest_begin, mean, camera, degree, color);
        finish(lane, i, color);
    };
}

static inline __device__ void harmonics_of_block(
    int block, const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<wp::vec3>& sh_rest, int rest_row, int rest_begin,
    const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec3>& camera, int degree, wp::array_t<wp::vec3>& colors
) {
    __shared__ float4 memory[GAUSSIANS * 3 / 4];
    float* staged = (float*)memory;
    each_color()(
        block, sh_dc, sh_rest, rest_row, rest_begin, means, (const float*)camera.data, degree,
        [&](int lane, long long, const float* color) {
            for (int c = 0; c < 3; ++c) staged[3 * lane + c] = color[c];
        }
    );
    __syncthreads();
    triples_of(block, means.shape.dims[0]).store(staged, (float*)colors.data);
}

// Write colours and depths side by side.
static inline __device__ void channels_of_block(
    int block, const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<wp::vec3>& sh_rest, int rest_row,
    const wp::array_t<wp::vec3>& means, const wp::array_t<float>& viewmat, const wp::array_t<float>& depths, int degree,
    wp::array_t<float>& channels
) {
    float camera[3] = {0.0f, 0.0f, 0.0f};
    for (int a = 0; a < 3; ++a)
        for (int r = 0; r < 3; ++r) camera[a] = camera[a] - viewmat.data[4 * r + a] * viewmat.data[4 * r + 3];
    each_color()(block, sh_dc, sh_rest, rest_row, 0, means, camera, degree, [&](int, long long i, const float* color) {
        ((float4*)channels.data)[i] = make_float4(color[0], color[1], color[2], depths.data[i]);
    });
}

// Compute the gradient to a Gaussian's mean from its higher coefficients; 0 if it overflows.
static inline __device__ void mean_gradient(
    const float* rest, const float* v, const float* d, float inverse, int degree, float* v_mean
) {
    const float x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
    auto dot = [&](int k) { return rest[3 * k] * v[0] + rest[3 * k + 1] * v[1] + rest[3 * k + 2] * v[2]; };
    float g[3] = {-SH_C1 * dot(2), -SH_C1 * dot(0), SH_C1 * dot(1)};
    if (degree > 1) {
        const float s4 = SH_C2 * dot(3), s5 = SH_C2 * dot(4), s6 = 6.0f * SH_C20 * dot(5), s7 = SH_C2 * dot(6);
        const float s8 = 2.0f * SH_C22 * dot(7);
        g[0] += s4 * y - s7 * z + s8 * x;
        g[1] += s4 * x - s5 * z - s8 * y;
        g[2] += s6 * z - s5 * y - s7 * x;
    }
    if (degree > 2) {
        const float s9 = 3.0f * SH_C33 * dot(8), s10 = SH_C32 * dot(9), s11 = SH_C31 * dot(10);
        const float s12 = 3.0f * SH_C30 * dot(11), s13 = SH_C31 * dot(12), s14 = SH_C3Z * dot(13);
        const float s15 = 3.0f * SH_C33 * dot(14);
        g[0] += -2.0f * s9 * x * y + s10 * y * z + s13 * (1.0f - 5.0f * zz) + 2.0f * s14 * x * z + s15 * (yy - xx);
        g[1] += s9 * (yy - xx) + s10 * x * z + s11 * (1.0f - 5.0f * zz) - 2.0f * s14 * y * z + 2.0f * s15 * x * y;
        g[2] += s10 * x * y - 10.0f * z * (s11 * y + s13 * x) + s12 * (5.0f * zz - 1.0f) + s14 * (xx - yy);
    }
    // Only a gradient's component perpendicular to the direction counts, because the direction is normalised.
    const float along = g[0] * x + g[1] * y + g[2] * z;
    bool whole = true;
    for (int a = 0; a < 3; ++a) {
        v_mean[a] = inverse * (g[a] - along * d[a]);
        whole = whole && fabsf(v_mean[a]) <= GRADIENT_MAX;
    }
    if (!whole)
        for (int a = 0; a < 3; ++a) v_mean[a] = 0.0f;
}

// Write the gradients to a row's coefficients, up to its end, over the coefficients.
static inline __device__ void write_gradients(
    float* own, int begin, int end, const float* v, const float* d, int degree, bool live
) {
    float* rest = own + 3 * begin;
    if (begin)
        for (int c = 0; c < 3; ++c) own[c] = SH_C0 * v[c];
    if (live) {
        each_basis()(d, degree, [&](int k, float value) {
            for (int c = 0; c < 3; ++c) rest[3 * k + c] = value * v[c];
        });
        rest += 3 * ((degree + 1) * (degree + 1) - 1);
    }
#pragma unroll 1
    for (; rest < own + end; ++rest) *rest = 0.0f;
}

static inline __device__ void harmonics_of_block_adjoint(
    int block, const wp::array_t<wp::vec3>& sh_rest, int rest_row, int rest_begin, const wp::array_t<wp::vec3>& means,
    const wp::array_t<wp::vec3>& camera, int degree, const wp::array_t<wp::vec3>& colors,
    const wp::array_t<wp::vec3>& v_colors, int has_rest, int has_means, wp::array_t<wp::vec3>& v_sh_dc,
    wp::array_t<wp::vec3>& v_sh_rest, wp::array_t<wp::vec3>& v_means
) {
    __shared__ float4 memory[GAUSSIANS * (COLUMNS + 1) / 4], dc_memory[GAUSSIANS * 3 / 4],
        mean_memory[GAUSSIANS * 3 / 4];
    __shared__ int alive[GAUSSIANS];
    float *staged = (float*)memory, *staged_dc = (float*)dc_memory, *staged_means = (float*)mean_memory;
    const Rows rows = coefficients_of(block, means.shape.dims[0], rest_row, rest_begin, degree);
    const Rows triples = triples_of(block, means.shape.dims[0]);
    const int lane = threadIdx.x;
    float v[3] = {0.0f, 0.0f, 0.0f}, mean[3] = {0.0f, 0.0f, 0.0f};
    if (lane < rows.n) {
        const long long i = (long long)block * GAUSSIANS + lane;
        for (int c = 0; c < 3; ++c) {
            const float color = ((const float*)colors.data)[3 * i + c];
            const float given = ((const float*)v_colors.data)[3 * i + c];
            v[c] = color > 0.0f && color < INFINITY ? given : 0.0f;
            mean[c] = ((const float*)means.data)[3 * i + c];
        }
    }
    // Coefficients of a culled or clamped Gaussian are not read: they are not needed, and a NaN must not spread.
    const bool live = v[0] != 0.0f || v[1] != 0.0f || v[2] != 0.0f;
    if (has_means && degree > 0) {
        if (lane < GAUSSIANS) alive[lane] = live;
        __syncthreads();
        rows.load(staged, (const float*)sh_rest.data, alive);
        __syncthreads();
    }
    if (lane < rows.n) {
        float d[3], v_mean[3] = {0.0f, 0.0f, 0.0f}, *own = staged + lane * rows.pitch;
        const float inverse = view_ray(mean, (const float*)camera.data, d);
        if (live && has_means && degree > 0) mean_gradient(own + 3 * rest_begin, v, d, inverse, degree, v_mean);
        if (has_rest) write_gradients(own, rest_begin, rows.kept, v, d, degree, live);
        for (int c = 0; c < 3; ++c) {
            staged_dc[3 * lane + c] = SH_C0 * v[c];
            staged_means[3 * lane + c] = v_mean[c];
        }
    }
    __syncthreads();
    if (has_rest) rows.store(staged, (float*)v_sh_rest.data);
    if (!rest_begin) triples.store(staged_dc, (float*)v_sh_dc.data);
    if (has_means) triples.store(staged_means, (float*)v_means.data);
}
