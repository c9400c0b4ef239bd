// Rotations of 16 Gaussians since rest, one Gaussian per lane.
#pragma once
#include "skinning_block.h"

// Write the rotation matrix from `rest` to `posed`, quaternions of any norm, row by row.
ALWAYS_INLINE void rotation_between(const vf* rest, const vf* posed, vf* to) {
    FUSE_WITHIN_EXPRESSIONS
    vf a[4], b[4];
    normalise(posed, inverse_norm(posed[0], posed[1], posed[2], posed[3]), a);
    normalise(rest, inverse_norm(rest[0], rest[1], rest[2], rest[3]), b);
    // a times the conjugate of b.
    const vf w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    const vf x = a[1] * b[0] - a[0] * b[1] + a[3] * b[2] - a[2] * b[3];
    const vf y = a[2] * b[0] - a[0] * b[2] + a[1] * b[3] - a[3] * b[1];
    const vf z = a[3] * b[0] - a[0] * b[3] + a[2] * b[1] - a[1] * b[2];
    to[0] = 1.0f - 2.0f * (y * y + z * z);
    to[1] = 2.0f * (x * y - w * z);
    to[2] = 2.0f * (x * z + w * y);
    to[3] = 2.0f * (x * y + w * z);
    to[4] = 1.0f - 2.0f * (x * x + z * z);
    to[5] = 2.0f * (y * z - w * x);
    to[6] = 2.0f * (x * z - w * y);
    to[7] = 2.0f * (y * z + w * x);
    to[8] = 1.0f - 2.0f * (x * x + y * y);
}

// Subtract the identity.
ALWAYS_INLINE void subtract_identity(vf* matrix) {
    for (int k = 0; k < 9; k += 4) matrix[k] = matrix[k] - 1.0f;
}
