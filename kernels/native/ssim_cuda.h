// Photometric loss on CUDA: a block of 256 threads per tile of 32 x 16 pixels of one channel, two pixels per thread.
#pragma once

#define ALL_LANES 0xffffffffu

enum {
    COLUMNS = SSIM_TILE_COLUMNS,
    ROWS = SSIM_TILE_ROWS,
    WIDE = COLUMNS + 10,  // a tile and the halo that its windows reach
    HIGH = ROWS + 10,
    PITCH = WIDE + 1,  // odd, so that threads that blur different rows read different banks
    QUADS = COLUMNS / 4,
};

// Position of a tile in its channel.
struct ImageTile {
    int channel, left, top, width, height;
    long long plane;  // number of pixels of a channel
};

static inline __device__ ImageTile image_tile(int block, const wp::array_t<float>& image) {
    ImageTile at;
    at.height = image.shape.dims[1];
    at.width = image.shape.dims[2];
    const int columns = (at.width + COLUMNS - 1) / COLUMNS, tiles = (at.height + ROWS - 1) / ROWS * columns;
    const int tile = block % tiles;
    at.channel = block / tiles;
    at.left = tile % columns * COLUMNS;
    at.top = tile / columns * ROWS;
    at.plane = (long long)at.height * at.width;
    return at;
}

// Return the weight of a pixel ``distance`` away from the window's centre. Loops over distances are unrolled, which
// makes the weights constants.
static inline __device__ float tap(int distance) {
    const float weights[6] = {SSIM_TAP_0, SSIM_TAP_1, SSIM_TAP_2, SSIM_TAP_3, SSIM_TAP_4, SSIM_TAP_5};
    return weights[distance < 0 ? -distance : distance];
}

// Return a function that calls ``read(at)`` for the pixels of tile and halo, ``at`` being the pixel's index in its
// channel, and ``write(row, column, values)`` with what it returned, or zeros outside the image.
static inline __device__ auto load_tile() {
    return [](const ImageTile& at, auto read, auto write) {
        for (int k = threadIdx.x; k < WIDE * HIGH; k += 256) {
            const int row = k / WIDE, column = k - row * WIDE;
            const int x = at.left + column - 5, y = at.top + row - 5;
            const bool inside = x >= 0 && x < at.width && y >= 0 && y < at.height;
            write(row, column, inside ? read((long long)y * at.width + x) : make_float4(0.0f, 0.0f, 0.0f, 0.0f));
        }
    };
}

// Return a function that blurs the rows of the loaded tile, four columns per thread: ``read(row, column, values)``
// gives the maps at a pixel, and sums go to ``blurred[(map * HIGH + row) * QUADS + column / 4]``.
static inline __device__ auto blur_rows() {
    return [](auto map_count, float4* blurred, auto read) {
        constexpr int MAPS = decltype(map_count)::value;
        const int row = threadIdx.x / QUADS, quad = threadIdx.x % QUADS;
        if (row >= HIGH) return;
        float sums[MAPS][4] = {};
#pragma unroll
        for (int k = 0; k < 14; ++k) {
            float values[MAPS];
            read(row, 4 * quad + k, values);
#pragma unroll
            for (int c = 0; c < 4; ++c)
                if (k >= c && k - c <= 10) {
#pragma unroll
                    for (int map = 0; map < MAPS; ++map) sums[map][c] = fmaf(tap(k - c - 5), values[map], sums[map][c]);
                }
        }
#pragma unroll
        for (int map = 0; map < MAPS; ++map)
            blurred[(map * HIGH + row) * QUADS + quad] =
                make_float4(sums[map][0], sums[map][1], sums[map][2], sums[map][3]);
    };
}

// Return a function that blurs the columns of what ``blur_rows`` stored, at the thread's two pixels:
// ``sums[k * maps + map]``.
static inline __device__ auto blur_columns() {
    return [](auto map_count, const float4* blurred, float* sums) {
        constexpr int MAPS = decltype(map_count)::value;
        const float* first = (const float*)blurred + threadIdx.x / COLUMNS * 2 * COLUMNS + threadIdx.x % COLUMNS;
#pragma unroll
        for (int map = 0; map < MAPS; ++map) {
            sums[map] = sums[MAPS + map] = 0.0f;
#pragma unroll
            for (int k = 0; k < 12; ++k) {
                const float value = first[(map * HIGH + k) * COLUMNS];
                if (k < 11) sums[map] = fmaf(tap(k - 5), value, sums[map]);
                if (k > 0) sums[MAPS + map] = fmaf(tap(k - 6), value, sums[MAPS + map]);
            }
        }
    };
}

// Return a function that calls ``finish(k, at, row, column)`` for those of the thread's two pixels that lie in the
// image; ``row`` and ``column`` are those of the loaded tile.
static inline __device__ auto each_pixel() {
    return [](const ImageTile& tile, auto finish) {
        const int column = threadIdx.x % COLUMNS, x = tile.left + column;
#pragma unroll
        for (int k = 0; k < 2; ++k) {
            const int row = threadIdx.x / COLUMNS * 2 + k, y = tile.top + row;
            if (x < tile.width && y < tile.height) finish(k, (long long)y * tile.width + x, row + 5, column + 5);
        }
    };
}

static inline __device__ void photometric_tile(
    int block, const wp::array_t<float>& image, const wp::array_t<float>& truth, const wp::array_t<bool>& mask,
    wp::array_t<float>& sums, wp::array_t<float>& partials
) {
    struct Maps {
        enum { value = 4 };
    };
    __shared__ float xs[HIGH][PITCH], ys[HIGH][PITCH];
    __shared__ float4 blurred[4 * HIGH * QUADS];
    __shared__ float of_warp[8][4];
    const ImageTile tile = image_tile(block, image);
    const float *own = image.data + tile.channel * tile.plane, *other = truth.data + tile.channel * tile.plane;
    load_tile()(
        tile,
        [&](long long at) {
            const float y = other[at];
            return make_float4(mask.data && !mask.data[at] ? y : own[at], y, 0.0f, 0.0f);
        },
        [&](int row, int column, const float4& pixel) {
            xs[row][column] = pixel.x;
            ys[row][column] = pixel.y;
        }
    );
    __syncthreads();
    blur_rows()(Maps(), blurred, [&](int row, int column, float* values) {
        const float x = xs[row][column], y = ys[row][column];
        values[0] = x;
        values[1] = y;
        values[2] = x * x + y * y;
        values[3] = x * y;
    });
    __syncthreads();
    float total[8], sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};  // |x - y|, SSIM, (x - y)^2, number of valid pixels
    blur_columns()(Maps(), blurred, total);
    each_pixel()(tile, [&](int k, long long at, int row, int column) {
        const bool valid = !mask.data || mask.data[at];
        const float mean_x = total[4 * k], mean_y = total[4 * k + 1];
        const float cross = mean_x * mean_y, squares = mean_x * mean_x + mean_y * mean_y;
        const float a1 = 2.0f * cross + SSIM_C1, a2 = 2.0f * (total[4 * k + 3] - cross) + SSIM_C2;
        const float b1 = squares + SSIM_C1, b2 = total[4 * k + 2] - squares + SSIM_C2;
        const float inverse = 1.0f / (b1 * b2), ssim = a1 * a2 * inverse;
        const float difference = xs[row][column] - ys[row][column];
        if (valid) {
            sum[0] += fabsf(difference);
            sum[1] += ssim;
            sum[2] += difference * difference;
            sum[3] += 1.0f;
        }
        if (partials.data) {
            float* to = partials.data + tile.channel * tile.plane + at;
            const long long map = image.shape.dims[0] * tile.plane;
            to[0] = valid ? 2.0f * inverse * (mean_y * (a2 - a1) + mean_x * ssim * (b1 - b2)) : 0.0f;
            to[map] = valid ? -ssim * inverse * b1 : 0.0f;
            to[2 * map] = valid ? 2.0f * a1 * inverse : 0.0f;
        }
    });
    // The first two steps halve the number of sums per lane, so that eight lanes share each; lane 8 j ends with sum j.
    const int thread = threadIdx.x;
    const bool last_two = thread & 16, second = thread & 8;
    for (int j = 0; j < 2; ++j) {
        const float kept = last_two ? sum[j + 2] : sum[j], given = last_two ? sum[j] : sum[j + 2];
        sum[j] = kept + __shfl_xor_sync(ALL_LANES, given, 16);
    }
    const float kept = second ? sum[1] : sum[0], given = second ? sum[0] : sum[1];
    float of_lanes = kept + __shfl_xor_sync(ALL_LANES, given, 8);
    for (int step = 4; step > 0; step >>= 1) of_lanes += __shfl_xor_sync(ALL_LANES, of_lanes, step);
    if ((thread & 7) == 0) of_warp[thread >> 5][(thread >> 3) & 3] = of_lanes;
    __syncthreads();
    if (thread < 4) {
        float whole = 0.0f;
        for (int warp = 0; warp < 8; ++warp) whole += of_warp[warp][thread];
        sums.data[4 * block + thread] = whole;
    }
}

static inline __device__ void sum_photometric(
    int /*block*/, const wp::array_t<float>& sums, double ssim_weight, double log_weight, wp::array_t<float>& results,
    wp::array_t<float>& slopes
) {
    __shared__ double total[256][4];
    const int thread = threadIdx.x, count = sums.shape.dims[0];
    double own[4] = {0.0, 0.0, 0.0, 0.0};
    for (int tile = thread; tile < count; tile += 256) {
        const float4 of_tile = ((const float4*)sums.data)[tile];
        own[0] += of_tile.x;
        own[1] += of_tile.y;
        own[2] += of_tile.z;
        own[3] += of_tile.w;
    }
    for (int j = 0; j < 4; ++j) total[thread][j] = own[j];
    for (int step = 128; step > 0; step >>= 1) {
        __syncthreads();
        if (thread < step)
            for (int j = 0; j < 4; ++j) total[thread][j] += total[thread + step][j];
    }
    if (thread > 0) return;
    const double valid = total[0][3], inverse = valid > 0.0 ? 1.0 / valid : 1.0;
    const double l1 = total[0][0] * inverse, error = total[0][2] * inverse;
    const double similarity = valid > 0.0 ? total[0][1] * inverse : 1.0;
    double loss = (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - similarity);
    if (log_weight != 0.0) loss += log_weight * log(error < SSIM_LEAST_ERROR ? SSIM_LEAST_ERROR : error);
    results.data[0] = (float)loss;
    results.data[1] = (float)l1;
    results.data[2] = (float)similarity;
    slopes.data[0] = (float)inverse;
    slopes.data[1] = error > SSIM_LEAST_ERROR ? (float)(log_weight / error * inverse) : 0.0f;
}

static inline __device__ void photometric_tile_adjoint(
    int block, const wp::array_t<float>& image, const wp::array_t<float>& truth, const wp::array_t<bool>& mask,
    const wp::array_t<float>& partials, const wp::array_t<float>& slopes, const wp::array_t<float>& v_loss,
    const wp::array_t<float>& v_l1, const wp::array_t<float>& v_ssim, float ssim_weight, wp::array_t<float>& v_image
) {
    struct Maps {
        enum { value = 3 };
    };
    __shared__ float loaded[3][HIGH][PITCH];
    __shared__ float4 blurred[3 * HIGH * QUADS];
    const ImageTile tile = image_tile(block, image);
    const long long first = tile.channel * tile.plane, map = image.shape.dims[0] * tile.plane;
    load_tile()(
        tile,
        [&](long long at) {
            const float* from = partials.data + first + at;
            return make_float4(from[0], from[map], from[2 * map], 0.0f);
        },
        [&](int row, int column, const float4& pixel) {
            loaded[0][row][column] = pixel.x;
            loaded[1][row][column] = pixel.y;
            loaded[2][row][column] = pixel.z;
        }
    );
    __syncthreads();
    blur_rows()(Maps(), blurred, [&](int row, int column, float* values) {
        for (int j = 0; j < 3; ++j) values[j] = loaded[j][row][column];
    });
    __syncthreads();
    float total[6];
    blur_columns()(Maps(), blurred, total);
    const float v = v_loss.data ? v_loss.data[0] : 0.0f;
    const float v_sum_l1 = ((v_l1.data ? v_l1.data[0] : 0.0f) + (1.0f - ssim_weight) * v) * slopes.data[0];
    const float v_sum_ssim = ((v_ssim.data ? v_ssim.data[0] : 0.0f) - ssim_weight * v) * slopes.data[0];
    const float v_sum_square = v * slopes.data[1];
    each_pixel()(tile, [&](int k, long long at, int, int) {
        float gradient = 0.0f;
        if (!mask.data || mask.data[at]) {
            const float x = image.data[first + at], y = truth.data[first + at];
            const float slope = x > y ? 1.0f : (x < y ? -1.0f : 0.0f);
            gradient =
                v_sum_l1 * slope + v_sum_ssim * (total[3 * k] + 2.0f * x * total[3 * k + 1] + y * total[3 * k + 2]);
            gradient += 2.0f * v_sum_square * (x - y);
        }
        v_image.data[first + at] = gradient;
    });
}
