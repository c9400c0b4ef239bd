"""Native snippets shared by ``skinning_cpu.py`` and its adjoint: sixteen Gaussians as lanes, and their control points.

Single Gaussians are rows of memory, and so are control points (``skinning_palette.py``); arithmetic is done in lanes.
Between them lie shuffles of whole registers: a Gaussian's fields are never read or written one float at a time.
"""

from __future__ import annotations

from .simd import LANE_SUMS

LANES = range(16)


def _shuffle(a: str, b: str, lanes: list[int]) -> str:
    return f"__builtin_shufflevector({a}, {b}, {', '.join(map(str, lanes))})"


def _split3() -> str:
    """Sixteen rows of three floats, in three registers, to three columns."""
    text = ""
    for c in range(3):
        at = [3 * lane + c for lane in LANES]
        head = _shuffle("a[0]", "a[1]", [i if i < 32 else 0 for i in at])
        text += f"to[{c}] = {_shuffle(head, 'a[2]', [lane if at[lane] < 32 else at[lane] - 16 for lane in LANES])};\n"
    return text


def _join3() -> str:
    text = ""
    for j in range(3):
        at = [divmod(16 * j + i, 3) for i in LANES]
        head = _shuffle("a[0]", "a[1]", [row + 16 * c if c < 2 else 0 for row, c in at])
        text += f"to[{j}] = {_shuffle(head, 'a[2]', [i if at[i][1] < 2 else 16 + at[i][0] for i in LANES])};\n"
    return text


def _split4() -> str:
    """Sixteen rows of four floats, in four registers, to four columns."""
    text = ""
    for p in range(2):
        for h in range(2):
            lanes = [4 * row + 2 * p + c for c in range(2) for row in range(8)]
            text += f"vf u{p}{h} = {_shuffle(f'a[{2 * h}]', f'a[{2 * h + 1}]', lanes)};\n"
    for c in range(4):
        half = [8 * (c % 2) + lane for lane in range(8)]
        text += f"to[{c}] = {_shuffle(f'u{c // 2}0', f'u{c // 2}1', half + [16 + lane for lane in half])};\n"
    return text


def _join4() -> str:
    text = ""
    for p in range(2):
        for h in range(2):
            lanes = [8 * h + row + 16 * c for row in range(8) for c in range(2)]
            text += f"vf u{p}{h} = {_shuffle(f'a[{2 * p}]', f'a[{2 * p + 1}]', lanes)};\n"
    for j in range(4):
        lanes = [8 * (j % 2) + 2 * row + c % 2 + 16 * (c // 2) for row in range(4) for c in range(4)]
        text += f"to[{j}] = {_shuffle(f'u0{j // 2}', f'u1{j // 2}', lanes)};\n"
    return text


def _quads(rows: tuple[str, str, str, str], to: tuple[str, str, str, str], name: str) -> str:
    """4 x 4 transpositions within quarters of registers, the cheapest shuffles there are."""
    quarters = range(0, 16, 4)
    low = [q + 16 * s + c for q in quarters for c in range(2) for s in range(2)]
    high = [lane + 2 for lane in low]
    near = [q + 16 * s + c for q in quarters for s in range(2) for c in range(2)]
    far = [lane + 2 for lane in near]
    text = ""
    for p in range(2):
        for half, lanes in (("l", low), ("h", high)):
            text += f"vf {name}{half}{p} = {_shuffle(rows[2 * p], rows[2 * p + 1], lanes)};\n"
    for c in range(4):
        half = "lh"[c // 2]
        text += f"{to[c]} = {_shuffle(f'{name}{half}0', f'{name}{half}1', far if c % 2 else near)};\n"
    return text


def _four(pattern: str) -> tuple[str, str, str, str]:
    return pattern.format(0), pattern.format(1), pattern.format(2), pattern.format(3)


def _transpose() -> str:
    """Of 16 x 16: four rows at a time within quarters, then whole quarters."""
    even, odd = ([16 * s + 8 * h + first + i for s in range(2) for h in range(2) for i in range(4)] for first in (0, 4))
    text = ""
    for g in range(4):
        rows = _four(f"rows[{4 * g} + {{}}]")
        text += f"vf q{g}[4];\n" + _quads(rows, _four(f"q{g}[{{}}]"), f"g{g}")
    for j in range(4):
        for pair in (0, 2):
            for name, lanes in (("e", even), ("o", odd)):
                text += f"vf {name}{pair}{j} = {_shuffle(f'q{pair}[{j}]', f'q{pair + 1}[{j}]', lanes)};\n"
        for column, name, lanes in ((0, "e", even), (8, "e", odd), (4, "o", even), (12, "o", odd)):
            text += f"rows[{column + j}] = {_shuffle(f'{name}0{j}', f'{name}2{j}', lanes)};\n"
    return text


def _lambda(name: str, body: str) -> str:
    """Columns or rows of ``a`` to those of ``to``."""
    return f"auto {name} = [](const vf* a, vf* to) INLINE {{\n{body}}};\n"


SIMD = (
    """
    // Multiply and add are fused within an expression, and only there.
    #pragma clang fp contract(on)
    #define INLINE __attribute__((always_inline))
    typedef float vf __attribute__((vector_size(64)));
    typedef int vi __attribute__((vector_size(64)));
    typedef float vu __attribute__((vector_size(64), aligned(4)));
    typedef float v4 __attribute__((vector_size(16)));
    typedef float v4u __attribute__((vector_size(16), aligned(4)));
    struct Any { enum { value = 0 }; }; struct Four { enum { value = 4 }; };
    const float infinity = __builtin_inff();
    const vi number = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    const vi upper = number >= 12;
    auto load = [](const float* at) INLINE -> vf { return *(const vu*)at; };
    auto put = [](float* at, vf value) INLINE { *(vu*)at = value; };
"""
    + _lambda("split3", _split3())
    + _lambda("join3", _join3())
    + _lambda("split4", _split4())
    + _lambda("join4", _join4())
    + """
    auto transpose = [](vf* rows) INLINE {
"""
    + _transpose()
    + """
    };
"""
    + _lambda("quads", _quads(_four("a[{}]"), _four("to[{}]"), "g"))
    + LANE_SUMS
    + """
    auto inverse_norm = [&](vf a, vf b, vf c, vf d) INLINE -> vf {  // 0 where the norm is 0 or not a number
        vf n = a * a + b * b + c * c + d * d;
        return ((n > 0.0f) & (n < infinity)) ? 1.0f / __builtin_elementwise_sqrt(n) : (vf){};
    };
    auto exponential = [](vf x) INLINE -> vf {  // of x <= 0; 0 below -87
        vf y = x < -87.0f ? (vf){} - 87.0f : x;
        vf shifted = y * 1.44269504f + 12582912.0f;
        vf n = shifted - 12582912.0f;
        vf f = y - n * 0.693359375f + n * 2.12194440e-4f;
        vf p = 1.0f + f * (1.0f + f * (0.5f + f * (0.16666667f + f * (4.16666667e-2f + f * (8.3333333e-3f
             + f * 1.3888889e-3f)))));
        vi bits = (__builtin_convertvector(n, vi) + 127) << 23;
        return x < -87.0f ? (vf){} : p * (vf)bits;
    };
"""
)
"""Types; ``split`` and ``join``: rows of 3 or 4 floats to lanes and back; transposition, sums of rows, functions."""

BLOCK = """
    // What a block of sixteen Gaussians from `begin` on reads. Lanes past the end are zero and look at node 0.
    const int N = means.shape[0], H = has_hyper ? hyper.shape[1] : 0;
    vf x[3], q[4], hyper_point[8];
    int rows = 0, spare_picks[256];
    float spare_weights[256];
    const int* pick = nullptr;  // [16, K] nodes
    auto read_rows = [&](auto& spare, const auto* from, int width) INLINE {
        if (rows == 16) return from;
        __builtin_memset(spare, 0, sizeof(spare));
        __builtin_memcpy(spare, from, sizeof(*from) * width * rows);
        return (decltype(from))spare;
    };
    auto read_vectors = [&](const void* data, int begin, auto width, vf* to) INLINE {
        constexpr int W = decltype(width)::value ? 4 : 3;
        float spare[16 * W];
        const float* from = read_rows(spare, (const float*)data + (long long)begin * W, W);
        vf a[W];
        for (int i = 0; i < W; ++i) a[i] = load(from + 16 * i);
        if (W == 4) split4(a, to);
        else split3(a, to);
    };
    auto write_vectors = [&](void* data, int begin, auto width, const vf* from) INLINE {
        constexpr int W = decltype(width)::value ? 4 : 3;
        vf a[4];
        if (W == 4) join4(from, a);
        else join3(from, a);
        __builtin_memcpy((float*)data + (long long)begin * W, a, rows == 16 ? 64 * W : 4 * W * rows);
    };
    auto read = [&](int begin, int K) INLINE {
        rows = N - begin < 16 ? N - begin : 16;
        read_vectors(means.data, begin, Any{}, x);
        read_vectors(quats.data, begin, Four{}, q);
        pick = read_rows(spare_picks, indices.data + (long long)begin * K, K);
        if (H)
            for (int d = 0; d < 8; ++d) {
                float lanes[16] = {};
                for (int l = 0; l < rows && d < H; ++l) lanes[l] = hyper.data[(begin + l) * (long long)H + d];
                hyper_point[d] = load(lanes);
            }
    };
    // Four floats of the nodes' rows, from `offset` on, of neighbour k.
    auto gather4 = [&](const float* table, int K, int k, vf* to) INLINE {
        vf a[4];  // quarter l of a[i]: lane 4 l + i
        for (int i = 0; i < 4; ++i) {
            v4 r[4];
            for (int l = 0; l < 4; ++l) r[l] = *(const v4u*)(table + 16ll * pick[(4 * l + i) * K + k]);
            auto low = __builtin_shufflevector(r[0], r[1], 0, 1, 2, 3, 4, 5, 6, 7);
            auto high = __builtin_shufflevector(r[2], r[3], 0, 1, 2, 3, 4, 5, 6, 7);
            a[i] = __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        }
        quads(a, to);
    };
    // Weights as columns and as rows of memory.
    auto weight_rows = [&](const vf* columns, int K, float* to) INLINE {
        if (K == 4) { vf a[4]; join4(columns, a); __builtin_memcpy(to, a, 256); }
        else
            for (int k = 0; k < K; ++k) {
                float lanes[16];
                put(lanes, columns[k]);
                #pragma clang loop vectorize(disable)
                for (int l = 0; l < 16; ++l) to[l * K + k] = lanes[l];
            }
    };
    auto weight_columns = [&](const float* from, int K, vf* to) INLINE {
        if (K == 4) { vf a[4]; for (int i = 0; i < 4; ++i) a[i] = load(from + 16 * i); split4(a, to); }
        else
            for (int k = 0; k < K; ++k) {
                float lanes[16];
                #pragma clang loop vectorize(disable)
                for (int l = 0; l < 16; ++l) lanes[l] = from[l * K + k];
                to[k] = load(lanes);
            }
    };
    // The palette's motion rows blended, as columns: affine map (12), rotation (4). A rotation counts on the side of
    // the first neighbour's: `side` is -1 where it must be turned; with `aligned` nobody's must.
    auto blend = [&](const float* weight, const vf* weights_of, int K, vf* side, vf* motion_columns) INLINE {
        for (int l = 0; l < 16; ++l) {
            vf row = (vf){} + weight[l * K] * load(motion.data + 16ll * pick[l * K]);
            for (int k = 1; k < K; ++k) row = row + weight[l * K + k] * load(motion.data + 16ll * pick[l * K + k]);
            motion_columns[l] = row;
        }
        transpose(motion_columns);
        if (!aligned) {
            vf front[4], r[4];
            gather4(motion.data + 12, K, 0, front);
            side[0] = (vf){} + 1.0f;
            for (int c = 0; c < 4; ++c) motion_columns[12 + c] = weights_of[0] * front[c];
            for (int k = 1; k < K; ++k) {
                gather4(motion.data + 12, K, k, r);
                vf cosine = r[0] * front[0] + r[1] * front[1] + r[2] * front[2] + r[3] * front[3];
                side[k] = cosine < 0.0f ? (vf){} - 1.0f : (vf){} + 1.0f;
                vf w = weights_of[k] * side[k];
                for (int c = 0; c < 4; ++c) motion_columns[12 + c] = motion_columns[12 + c] + w * r[c];
            }
        }
    };
    // e = x - p of neighbour k, -1 / (2 r^2) behind it; its square; hyper-coordinates from e[4] on.
    auto offset = [&](int K, int k, vf* e) INLINE -> vf {
        vf node[4];
        gather4(reach.data, K, k, node);
        for (int c = 0; c < 3; ++c) e[c] = x[c] - node[c];
        e[3] = node[3];
        vf d2 = e[0] * e[0] + e[1] * e[1] + e[2] * e[2];
        for (int h = 0; h < H; h += 4) {
            gather4(reach.data + 8 + h, K, k, node);
            for (int c = 0; c < 4; ++c) {
                vf& other = e[4 + h + c];
                other = hyper_point[h + c] - node[c];
                d2 = d2 + other * other;
            }
        }
        return d2;
    };
"""
