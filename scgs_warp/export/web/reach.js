// Inverse kinematics (scgs_warp/edit/reach.py): the least turns of a chain of joints that take a point to a place.

const BEND = 100, TWIST = 1000, SLIDE = 3000, OFF_AXIS = 4, PULL = 1e6; // costs, as there
const STEPS = 6, LONGEST_TURN = 0.5;

// Solve a symmetric positive system by Gaussian elimination, in place.
function solveDense(matrix, right) {
  const n = right.length;
  for (let k = 0; k < n; k++) {
    for (let r = k + 1; r < n; r++) {
      const factor = matrix[r][k] / matrix[k][k];
      if (!factor) continue;
      for (let c = k; c < n; c++) matrix[r][c] -= factor * matrix[k][c];
      right[r] -= factor * right[k];
    }
  }
  for (let k = n - 1; k >= 0; k--) {
    for (let c = k + 1; c < n; c++) right[k] -= matrix[k][c] * right[c];
    right[k] /= matrix[k][k];
  }
  return right;
}

// links: { joint, quat, shift, axis } from the base to the end; base: motion of what carries the first; grip: point of
// the last part, unturned. Returns { turns, shift (of the first joint), end }.
function posedChain(links, pose, base, grip) {
  let motion = base;
  const points = links.map((link, row) => {
    const joint = plus(link.joint, row ? link.shift : pose.shift), point = moveBy(motion, joint), turn = pose.turns[row];
    motion = after(motion, { quat: turn, shift: plus(joint, qRotate(turn, link.joint), -1) });
    return point;
  });
  return { points, end: moveBy(motion, grip) };
}

function reach(links, base, grip, place) {
  let pose = { turns: links.map((link) => link.quat), shift: links[0].shift };
  const { points, end } = posedChain(links, pose, base, grip), centre = points[0];
  const way = [...points, end];
  let length = 1e-12;
  for (let k = 1; k < way.length; k++) length += Math.hypot(...plus(way[k], way[k - 1], -1));
  const here = plus(end, centre, -1), far = Math.hypot(...plus(place, centre, -1));
  const there = plus(place, centre, -1).map((value) => value * Math.min(1, length / Math.max(far, 1e-300)));
  const costs = links.map((link, row) => (row ? bendCost(link.axis) : swingCost(links)));
  for (let step = 1; step <= STEPS; step++) {
    const aim = plus(centre, between(here, there, step / STEPS));
    pose = approach(links, costs, pose, base, grip, aim, length, step === STEPS ? 40 : 4);
  }
  return pose;
}

// A vector between two, turned and lengthened evenly.
function between(here, there, share) {
  const near = Math.hypot(...here), far = Math.hypot(...there);
  if (share === 1 || Math.min(near, far) < 1e-12) return plus(here, plus(there, here, -1), share);
  const a = here.map((v) => v / near), b = there.map((v) => v / far), across = plus(b, a, -dot(a, b));
  const size = Math.hypot(...across), angle = Math.atan2(Math.hypot(...cross(a, b)), dot(a, b));
  if (size < 1e-9) return plus(here, plus(there, here, -1), share);
  const reached = near + share * (far - near), c = Math.cos(share * angle), s = Math.sin(share * angle) / size;
  return a.map((v, k) => reached * (c * v + s * across[k]));
}

// Gauss-Newton steps for the cost of the change since the links' present pose plus the pull.
function approach(links, costs, pose, base, grip, aim, length, iterations) {
  const pull = PULL / length ** 2, slide = SLIDE / length ** 2, size = 3 * links.length + 3;
  for (let iteration = 0; iteration < iterations; iteration++) {
    const { points, end } = posedChain(links, pose, base, grip);
    const columns = []; // of the end's derivative
    let frame = base.quat;
    for (let a = 0; a < 3; a++) columns.push(qRotate(frame, [0, 1, 2].map((k) => (k === a ? 1 : 0))));
    points.forEach((point, row) => {
      const arm = plus(end, point, -1);
      for (let a = 0; a < 3; a++) columns.push(cross(qRotate(frame, [0, 1, 2].map((k) => (k === a ? 1 : 0))), arm));
      frame = qMultiply(frame, pose.turns[row]);
    });
    const miss = plus(end, aim, -1);
    const normal = columns.map((u) => columns.map((v) => pull * dot(u, v))), slope = columns.map((u) => pull * dot(u, miss));
    for (let a = 0; a < 3; a++) {
      normal[a][a] += slide;
      slope[a] += slide * (pose.shift[a] - links[0].shift[a]);
    }
    links.forEach((link, row) => {
      const since = qLogarithm(qMultiply(pose.turns[row], qConjugate(link.quat))), inner = changeOfLogarithm(since);
      const weighted = product(costs[row], inner), at = 3 * row + 3;
      for (let a = 0; a < 3; a++) {
        for (let b = 0; b < 3; b++) {
          for (let c = 0; c < 3; c++) normal[at + a][at + b] += inner[c][a] * weighted[c][b];
          slope[at + a] += weighted[b][a] * since[b];
        }
      }
    });
    const change = solveDense(normal, slope).map((value) => -value);
    let most = 1e-300;
    for (let k = 3; k < size; k += 3) most = Math.max(most, Math.hypot(change[k], change[k + 1], change[k + 2]));
    const share = Math.min(1, LONGEST_TURN / most);
    pose = {
      turns: pose.turns.map((turn, row) =>
        qMultiply(qExponential(change.slice(3 * row + 3, 3 * row + 6).map((v) => share * v)), turn)),
      shift: plus(pose.shift, change.slice(0, 3), share),
    };
    if (most < 1e-6) break;
  }
  return pose;
}

// Return the 3 x 3 matrix one * I + two * v v^T.
const alongAndAcross = (one, two, v) => v.map((x, a) => v.map((y, b) => (a === b ? one : 0) + two * x * y));

const product = (left, right) => left.map((row) => right[0].map((_, c) => row.reduce((sum, x, k) => sum + x * right[k][c], 0)));

// Quadratic form of an inner joint's cost: a turn across a known axis costs more than one about it.
function bendCost(axis) {
  return axis ? alongAndAcross(BEND * OFF_AXIS, -BEND * (OFF_AXIS - 1), axis) : alongAndAcross(BEND, 0, [0, 0, 0]);
}

// That of the first joint: a twist about the line to the last joint costs more than a swing.
function swingCost(links) {
  const bone = qRotate(links[0].quat, plus(links[links.length - 1].joint, links[0].joint, -1)), square = dot(bone, bone);
  return alongAndAcross(1, square < 1e-18 ? 0 : (TWIST - 1) / square, bone);
}

// Derivative of a rotation vector by a small turn that follows the rotation.
function changeOfLogarithm(v) {
  const angle = Math.hypot(...v), [x, y, z] = v, turn = [[0, -z, y], [z, 0, -x], [-y, x, 0]], twice = product(turn, turn);
  const second = angle < 1e-3 ? 1 / 12 : (1 / angle - 0.5 / Math.tan(0.5 * angle)) / angle;
  return turn.map((row, a) => row.map((value, b) => (a === b ? 1 : 0) - 0.5 * value + second * twice[a][b]));
}
