// Quaternions (wxyz) and rigid motions, as scgs_warp/edit/rotations.py has them.

const IDENTITY = [1, 0, 0, 0];
const qMultiply = ([aw, ax, ay, az], [bw, bx, by, bz]) => [
  aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
  aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
];
const qConjugate = ([w, x, y, z]) => [w, -x, -y, -z];
const qRotate = (q, v) => {
  const t = cross(q.slice(1), v).map((value) => 2 * value);
  return plus(plus(v, t, q[0]), cross(q.slice(1), t));
};
const qUnit = (q) => {
  const norm = Math.hypot(...q);
  return norm > 0 ? q.map((value) => value / norm) : [...IDENTITY];
};
const isStill = (q) => !(q[1] || q[2] || q[3]);

// Rotation vector of the shorter arc, and back.
function qLogarithm(q) {
  const [w, ...v] = q[0] < 0 ? q.map((value) => -value) : q, sine = Math.hypot(...v);
  return v.map((value) => value * (sine > 1e-12 ? (2 * Math.atan2(sine, w)) / sine : 2));
}

function qExponential(v) {
  const angle = Math.hypot(...v), factor = angle > 1e-9 ? Math.sin(angle / 2) / angle : 0.5;
  return [Math.cos(angle / 2), ...v.map((value) => factor * value)];
}

const qPower = (q, share) => (share === 1 ? q : qExponential(qLogarithm(q).map((value) => share * value)));

// A rigid motion x -> R x + shift.
const STILL = { quat: IDENTITY, shift: [0, 0, 0] };
const moveBy = ({ quat, shift }, point) => plus(qRotate(quat, point), shift);
const after = (second, first) => ({
  quat: qMultiply(second.quat, first.quat), shift: plus(qRotate(second.quat, first.shift), second.shift),
});

// Eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix, by Jacobi's rotations.
function principal(matrix) {
  const a = matrix.map((row) => [...row]), v = [0, 1, 2, 3].map((r) => [0, 1, 2, 3].map((c) => (r === c ? 1 : 0)));
  for (let sweep = 0; sweep < 12; sweep++) {
    for (let p = 0; p < 3; p++) {
      for (let q = p + 1; q < 4; q++) {
        if (Math.abs(a[p][q]) < 1e-300) continue;
        const theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
        const t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.sqrt(theta * theta + 1));
        const c = 1 / Math.sqrt(t * t + 1), s = t * c;
        for (let k = 0; k < 4; k++) [a[k][p], a[k][q]] = [c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]];
        for (let k = 0; k < 4; k++) [a[p][k], a[q][k]] = [c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]];
        for (let k = 0; k < 4; k++) [v[k][p], v[k][q]] = [c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]];
      }
    }
  }
  let best = 0;
  for (let k = 1; k < 4; k++) if (a[k][k] > a[best][best]) best = k;
  return qUnit(v.map((row) => row[best]));
}

// The motion x -> R (x - before) + after that fits some rows of points [M * 3] best (Horn 1987).
function rigidFit(from, to, rows) {
  const before = [0, 0, 0], behind = [0, 0, 0], s = Array.from({ length: 3 }, () => [0, 0, 0]);
  for (const m of rows) {
    for (let a = 0; a < 3; a++) {
      before[a] += from[3 * m + a] / rows.length;
      behind[a] += to[3 * m + a] / rows.length;
    }
  }
  let most = 0;
  for (const m of rows) {
    for (let a = 0; a < 3; a++) {
      for (let b = 0; b < 3; b++) s[a][b] += (from[3 * m + a] - before[a]) * (to[3 * m + b] - behind[b]);
    }
  }
  for (const row of s) for (const value of row) most = Math.max(most, Math.abs(value));
  if (!(most > 1e-60)) return { quat: [...IDENTITY], before, after: behind };
  const [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = s.map((row) => row.map((value) => value / most));
  const quat = principal([
    [xx + yy + zz, yz - zy, zx - xz, xy - yx], [yz - zy, xx - yy - zz, xy + yx, zx + xz],
    [zx - xz, xy + yx, yy - xx - zz, yz + zy], [xy - yx, zx + xz, yz + zy, zz - xx - yy],
  ]);
  return { quat: quat[0] < 0 ? quat.map((value) => -value) : quat, before, after: behind };
}
