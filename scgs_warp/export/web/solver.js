// As-rigid-as-possible deformation of the control points (scgs_warp/edit/solver.py): edges keep their shape and their
// length, and neighbours their rotations. Each step fits the rotation of every point, then solves for positions.

const SMOOTHNESS = 0.3, STRETCH = 2;
const LIMIT = 10, SHORTEST = 0.92, LONGEST = 1.05; // an edge outside these multiples of its rest length costs more
const ITERATIONS = { exact: 120, live: 12 };
const NEAR = 0.25; // of an edge's length, by which held points may move and edges keep their directions
const TOLERANCE = 1e-4; // of an edge's length
const FIT_STEPS = 12;

class Graph {
  // edges: two lists of ends; length: of an edge.
  constructor(count, first, second, length) {
    this.count = count;
    this.length = length;
    this.begin = new Int32Array(count + 1);
    for (let e = 0; e < first.length; e++) {
      this.begin[first[e] + 1]++;
      this.begin[second[e] + 1]++;
    }
    for (let m = 0; m < count; m++) this.begin[m + 1] += this.begin[m];
    const free = this.begin.slice(), others = new Int32Array(2 * first.length);
    for (let e = 0; e < first.length; e++) {
      others[free[first[e]]++] = second[e];
      others[free[second[e]]++] = first[e];
    }
    this.others = others;
    this.component = this.components();
  }

  around(m) {
    return this.others.subarray(this.begin[m], this.begin[m + 1]);
  }

  components() {
    const label = new Int32Array(this.count).fill(-1);
    for (let m = 0; m < this.count; m++) {
      if (label[m] >= 0) continue;
      const stack = [m];
      label[m] = m;
      while (stack.length) {
        for (const n of this.around(stack.pop())) {
          if (label[n] < 0) {
            label[n] = m;
            stack.push(n);
          }
        }
      }
    }
    return label;
  }
}

// The rotation nearest to a matrix (Mueller et al. 2016), from `quat` on, in place. s: columns of images of the axes.
function fitRotation(s, quat, offset) {
  let q = [quat[offset], quat[offset + 1], quat[offset + 2], quat[offset + 3]];
  for (let step = 0; step < FIT_STEPS; step++) {
    const r = rotationRows(q);
    let x = 0, y = 0, z = 0, size = 1e-9;
    for (let c = 0; c < 3; c++) {
      const rx = r[c], ry = r[3 + c], rz = r[6 + c], sx = s[c], sy = s[3 + c], sz = s[6 + c];
      x += ry * sz - rz * sy;
      y += rz * sx - rx * sz;
      z += rx * sy - ry * sx;
      size += rx * sx + ry * sy + rz * sz;
    }
    const turn = [x, y, z].map((value) => value / Math.abs(size));
    if (Math.hypot(...turn) < 1e-9) break;
    q = qUnit(qMultiply(qExponential(turn), q));
  }
  quat.set(q, offset);
}

class Solver {
  constructor(graph) {
    this.graph = graph;
    this.residual = new Float64Array(3 * graph.count);
    this.search = new Float64Array(3 * graph.count);
    this.product = new Float64Array(3 * graph.count);
    this.sums = new Float64Array(3 * graph.count);
  }

  // rest: [M * 3]; anchors: { hard, soft, told (flags or weights [M]), targets [M * 3], turns [M * 4] };
  // shape: { points [M * 3], turns [M * 4] }, changed in place.
  relax(rest, anchors, shape, iterations) {
    const { graph } = this, { hard, soft, told, targets, turns } = anchors;
    const near = this.isNear(anchors, shape.anchors);
    shape.anchors = anchors;
    const alive = new Set();
    for (let m = 0; m < graph.count; m++) if (hard[m] || soft[m]) alive.add(graph.component[m]);
    const free = [], turning = [];
    for (let m = 0; m < graph.count; m++) {
      if (told[m]) for (let a = 0; a < 4; a++) shape.turns[4 * m + a] = turns[4 * m + a];
      if (hard[m]) for (let a = 0; a < 3; a++) shape.points[3 * m + a] = targets[3 * m + a];
      if (!alive.has(graph.component[m]) || graph.begin[m] === graph.begin[m + 1]) continue;
      if (!hard[m]) free.push(m);
      if (!told[m]) turning.push(m);
    }
    const before = new Float64Array(3 * graph.count);
    for (let step = 0; step <= iterations; step++) {
      if (step) for (const m of turning) this.turn(m, rest, shape);
      if (!free.length) break;
      this.addEdges(free, hard, soft, targets, rest, shape, step || near ? STRETCH : 0, step || near ? LIMIT : 0);
      before.set(shape.points);
      this.solve(free, hard, soft, shape.points);
      let moved = 0;
      for (const m of free) {
        for (let a = 3 * m; a < 3 * m + 3; a++) moved = Math.max(moved, Math.abs(shape.points[a] - before[a]));
      }
      if (step && !(moved > TOLERANCE * graph.length)) break;
    }
  }

  // Whether held points moved so little that the solution goes on where it was.
  isNear({ hard, targets }, before) {
    if (!before) return false;
    for (let m = 0; m < this.graph.count; m++) {
      if (hard[m] !== before.hard[m]) return false;
      if (!hard[m]) continue;
      const moved = [0, 1, 2].map((a) => targets[3 * m + a] - before.targets[3 * m + a]);
      if (Math.hypot(...moved) > NEAR * this.graph.length) return false;
    }
    return true;
  }

  turn(m, rest, { points, turns }) {
    const s = new Float64Array(9), { graph } = this, smooth = SMOOTHNESS * graph.length ** 2;
    for (const n of graph.around(m)) {
      const r = rotationRows([turns[4 * n], turns[4 * n + 1], turns[4 * n + 2], turns[4 * n + 3]]);
      for (let a = 0; a < 3; a++) {
        const posed = points[3 * n + a] - points[3 * m + a];
        for (let c = 0; c < 3; c++) s[3 * a + c] += posed * (rest[3 * n + c] - rest[3 * m + c]) + smooth * r[3 * a + c];
      }
    }
    fitRotation(s, turns, 4 * m);
  }

  addEdges(free, hard, soft, targets, rest, { points, turns }, stretch, limit) {
    const { graph, sums } = this, edge = [0, 0, 0], weight = 1 + stretch + 0.5 * limit;
    const rotation = (m) => rotationRows([turns[4 * m], turns[4 * m + 1], turns[4 * m + 2], turns[4 * m + 3]]);
    for (const m of free) {
      const own = rotation(m), pull = soft[m] * graph.around(m).length;
      for (let a = 0; a < 3; a++) sums[3 * m + a] = pull * targets[3 * m + a];
      for (const n of graph.around(m)) {
        const its = rotation(n), wanted = [0, 0, 0], posed = [0, 0, 0];
        for (let a = 0; a < 3; a++) {
          edge[a] = rest[3 * m + a] - rest[3 * n + a];
          posed[a] = points[3 * m + a] - points[3 * n + a];
        }
        for (let a = 0; a < 3; a++) {
          for (let c = 0; c < 3; c++) wanted[a] += 0.5 * (own[3 * a + c] + its[3 * a + c]) * edge[c];
        }
        const size = Math.hypot(...posed);
        let along = 0, kept = 0, allowed = 0; // share of the edge's direction, and its factors
        if (stretch && size > 0) {
          along = Math.max(dot(posed, wanted) / Math.max(size * Math.hypot(...wanted), 1e-300), 0);
          const old = Math.hypot(...edge);
          kept = (along * old) / size;
          allowed = (along * Math.min(Math.max(size, SHORTEST * old), LONGEST * old)) / size;
        }
        for (let a = 0; a < 3; a++) {
          const turned = (1 - along) * wanted[a];
          const asked = wanted[a] + stretch * (kept * posed[a] + turned)
            + limit * (allowed * posed[a] + turned - 0.5 * posed[a]);
          sums[3 * m + a] += asked / weight + (hard[n] ? points[3 * n + a] : 0);
        }
      }
    }
  }

  // Conjugate gradients for the Laplacian of the free points, from where they are.
  solve(free, hard, soft, points) {
    const { graph, residual, search, product, sums } = this;
    const apply = (values, into) => {
      for (const m of free) {
        const around = graph.around(m), degree = around.length * (1 + soft[m]);
        for (let a = 0; a < 3; a++) {
          let sum = degree * values[3 * m + a];
          for (const n of around) if (!hard[n]) sum -= values[3 * n + a];
          into[3 * m + a] = sum;
        }
      }
    };
    const inner = (a, b) => {
      let sum = 0;
      for (const m of free) for (let k = 3 * m; k < 3 * m + 3; k++) sum += a[k] * b[k];
      return sum;
    };
    apply(points, product);
    for (const m of free) for (let k = 3 * m; k < 3 * m + 3; k++) search[k] = residual[k] = sums[k] - product[k];
    let size = inner(residual, residual);
    const enough = 1e-8 * graph.length ** 2;
    for (let step = 0; step < 200 && size > enough; step++) {
      apply(search, product);
      const length = size / inner(search, product);
      for (const m of free) {
        for (let k = 3 * m; k < 3 * m + 3; k++) {
          points[k] += length * search[k];
          residual[k] -= length * product[k];
        }
      }
      const next = inner(residual, residual);
      for (const m of free) for (let k = 3 * m; k < 3 * m + 3; k++) search[k] = residual[k] + (next / size) * search[k];
      size = next;
    }
  }
}
