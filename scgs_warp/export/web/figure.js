// Parts of the scene and their pose (scgs_warp/edit/part_pose.py): turns of joints, the bodies that move with them, and
// the control points between the bodies, which the solver bends.

const FREE_RINGS = 3; // on either side of a turned joint
const HELD_SHARE = 0.25; // of a body's control points, at least
const INNER_STIFFNESS = 0.03; // of a short body between two others
const FEW = 4; // control points, below which they show no rotation by themselves
const STEP_ANGLE = Math.PI / 12, LONGEST_PATH = 48;

class Figure {
  constructor(model) {
    const { facts, nodes, pose } = model;
    this.model = model;
    this.count = nodes;
    // name, parent (row, -1 for roots), joint, axis, and the rows of the parts that a pull turns
    this.parts = facts.parts.map((part, row) => ({ ...part, chain: facts.pose.chains[row] }));
    this.owner = pose.owner;
    this.start = pose.start;
    this.graph = new Graph(nodes, pose.first, pose.second, facts.pose.edge_length);
    this.solver = new Solver(this.graph);
    this.members = this.parts.map((_, row) => this.withSurroundings(row));
    this.order = [];
    const add = (row) => {
      this.order.push(row);
      this.parts.forEach((part, child) => part.parent === row && add(child));
    };
    this.parts.forEach((part, row) => part.parent < 0 && add(row));
    this.now = new Float64Array(3 * nodes);
    this.reset();
  }

  reset() {
    this.turns = this.parts.map(() => IDENTITY); // relative to the parent, in its frame at time 0
    this.shifts = this.parts.map(() => [0, 0, 0]);
    this.version = (this.version ?? 0) + 1;
    this.shape = null;
  }

  get posed() {
    return this.turns.some((turn) => !isStill(turn)) || this.shifts.some((shift) => shift.some(Boolean));
  }

  // What undo restores.
  state() {
    return { turns: [...this.turns], shifts: [...this.shifts] };
  }

  restore({ turns, shifts }) {
    this.turns = [...turns];
    this.shifts = [...shifts];
    this.version++;
    if (!this.posed) this.shape = null;
  }

  withSurroundings(row) {
    const own = [];
    for (let m = 0; m < this.count; m++) if (this.owner[m] === row) own.push(m);
    if (own.length >= FEW) return own;
    const all = new Set(own);
    for (const m of own) for (const n of this.graph.around(m)) all.add(n);
    return [...all].sort((a, b) => a - b);
  }

  // Where the motion has the control points, from the table of poses before the figure is posed.
  observe(table) {
    const { facts, trajectories: { rest } } = this.model;
    for (let m = 0; m < this.count; m++) {
      this.now.set(mapped(nodeMap(facts, table, m), rest.subarray(3 * m, 3 * m + 3)), 3 * m);
    }
    this.frames = this.parts.map((part, row) => this.jointFrame(part, row));
  }

  // A part's joint now, and the turn of its parent since time 0.
  jointFrame(part, row) {
    const own = rigidFit(this.start, this.now, this.members[row]);
    const lead = part.parent < 0 ? own : rigidFit(this.start, this.now, this.members[part.parent]);
    return { joint: plus(qRotate(own.quat, plus(part.joint, own.before, -1)), own.after), frame: lead.quat };
  }

  local(row, share = 1) {
    const { joint, frame } = this.frames[row], turn = qPower(this.turns[row], share);
    const quat = isStill(turn) ? IDENTITY : qMultiply(qMultiply(frame, turn), qConjugate(frame));
    const shift = qRotate(frame, this.shifts[row].map((value) => share * value));
    return { quat, shift: plus(plus(joint, shift), qRotate(quat, joint), -1) };
  }

  // The rigid motion of every part, and the body that it belongs to: the row of its topmost part, or -1.
  motions() {
    const found = this.parts.map(() => STILL), body = this.parts.map(() => -1);
    for (const row of this.order) {
      const above = this.parts[row].parent;
      if (above >= 0) [found[row], body[row]] = [found[above], body[above]];
      if (isStill(this.turns[row]) && !this.shifts[row].some(Boolean)) continue;
      found[row] = after(found[row], this.local(row));
      body[row] = row;
    }
    return { found, body };
  }

  // Control points that their bodies hold: those far from other bodies, or the furthest if these are few.
  held(body) {
    const { graph, count } = this, label = Array.from(this.owner, (row) => body[row]);
    const rings = new Uint8Array(count).fill(FREE_RINGS + 1);
    let front = [];
    for (let m = 0; m < count; m++) {
      if (graph.around(m).some((n) => label[n] !== label[m])) {
        rings[m] = 1;
        front.push(m);
      }
    }
    for (let ring = 2; ring <= FREE_RINGS; ring++) {
      const next = [];
      for (const m of front) {
        for (const n of graph.around(m)) {
          if (label[n] === label[m] && rings[n] > ring) {
            rings[n] = ring;
            next.push(n);
          }
        }
      }
      front = next;
    }
    const most = {}, least = {};
    for (const body of new Set(label)) {
      const own = rings.filter((_, m) => label[m] === body).sort();
      most[body] = own[own.length - 1];
      least[body] = own[Math.floor((own.length - 1) * (1 - HELD_SHARE))];
    }
    return { label, most, held: rings.map((ring, m) => (ring >= least[label[m]] ? 1 : 0)) };
  }

  anchors(found, body) {
    const { count, now } = this, { label, most, held } = this.held(body);
    const carries = (b) => b >= 0 && this.parts.some((part, row) => body[row] === row && part.parent >= 0
      && row !== b && body[part.parent] === b);
    const anchors = { hard: new Uint8Array(count), soft: new Float64Array(count), told: new Uint8Array(count),
      targets: new Float64Array(3 * count), turns: new Float64Array(4 * count) };
    for (let m = 0; m < count; m++) {
      if (!held[m]) continue;
      const motion = label[m] < 0 ? STILL : found[label[m]];
      anchors.targets.set(moveBy(motion, now.subarray(3 * m, 3 * m + 3)), 3 * m);
      anchors.turns.set(motion.quat, 4 * m);
      const slack = most[label[m]] <= FREE_RINGS && carries(label[m]);
      if (slack) anchors.soft[m] = INNER_STIFFNESS;
      else anchors.hard[m] = anchors.told[m] = 1;
    }
    return anchors;
  }

  // Bring the table of poses into the figure's pose. exact: the result depends on the pose alone, not on the way to it.
  apply(table, exact) {
    this.observe(table);
    if (!this.posed) return;
    const { found, body } = this.motions(), kind = body.join();
    if (exact || !this.shape) this.shape = this.path(exact ? ITERATIONS.exact : ITERATIONS.live);
    else {
      if (this.kind !== kind) this.carry(found);
      this.solver.relax(this.now, this.anchors(found, body), this.shape, ITERATIONS.live);
    }
    this.kind = kind;
    this.write(table);
  }

  // From the unposed shape in small steps, as far as turns of 15 degrees take.
  path(iterations) {
    const { turns, shifts, count } = this, shape = { points: this.now.slice(), turns: new Float64Array(4 * count) };
    for (let m = 0; m < count; m++) shape.turns[4 * m] = 1;
    const largest = Math.max(...turns.map((turn) => Math.hypot(...qLogarithm(turn))));
    const farthest = Math.max(...shifts.map((shift) => Math.hypot(...shift)));
    const wanted = Math.max(largest / STEP_ANGLE, farthest / (2 * this.graph.length));
    const steps = Math.min(LONGEST_PATH, Math.max(1, Math.ceil(wanted)));
    for (let step = 1; step <= steps; step++) {
      this.turns = turns.map((turn) => qPower(turn, step / steps));
      this.shifts = shifts.map((shift) => shift.map((value) => (value * step) / steps));
      const { found, body } = this.motions();
      this.solver.relax(this.now, this.anchors(found, body), shape, step === steps ? iterations : ITERATIONS.live);
    }
    this.turns = turns;
    this.shifts = shifts;
    return shape;
  }

  // Start where the bodies are, when others begin to move.
  carry(found) {
    this.shape.anchors = null;
    for (let m = 0; m < this.count; m++) {
      const motion = found[this.owner[m]];
      this.shape.points.set(moveBy(motion, this.now.subarray(3 * m, 3 * m + 3)), 3 * m);
      this.shape.turns.set(motion.quat, 4 * m);
    }
  }

  write(table) {
    const { facts, trajectories: { rest } } = this.model, { points, turns } = this.shape, width = nodeWidth(facts);
    const handles = layered(facts);
    for (let m = 0; m < this.count; m++) {
      const turn = Array.from(turns.subarray(4 * m, 4 * m + 4)), rows = rotationRows(turn), map = [];
      const own = rest.subarray(3 * m, 3 * m + 3), row = width * m + (handles ? 28 : 0);
      const from = handles ? mapped(table.subarray(width * m, width * m + 12), own) : own;
      for (let r = 0; r < 3; r++) {
        for (let c = 0; c < 3; c++) {
          let sum = 0;
          for (let k = 0; k < 3; k++) sum += rows[3 * r + k] * table[row + 4 * k + c];
          map.push(sum);
        }
      }
      for (let r = 0; r < 3; r++) {
        let offset = points[3 * m + r];
        for (let c = 0; c < 3; c++) {
          table[row + 4 * r + c] = map[3 * r + c];
          offset -= map[3 * r + c] * from[c];
        }
        table[row + 4 * r + 3] = offset;
      }
      for (const first of handles ? [12] : [12, 24]) {
        table.set(qMultiply(turn, Array.from(table.subarray(row + first, row + first + 4))), row + first);
      }
    }
  }

  // The control point nearest to a place, as it is drawn.
  nearest(place) {
    const points = this.posed && this.shape ? this.shape.points : this.now;
    let best = 0, least = Infinity;
    for (let m = 0; m < this.count; m++) {
      let away = 0;
      for (let a = 0; a < 3; a++) away += (points[3 * m + a] - place[a]) ** 2;
      if (away < least) [best, least] = [m, away];
    }
    return best;
  }

  // Begin to pull a part by a point of it, in the present pose: place(where) goes on.
  pull(row, grip) {
    const chain = this.parts[row].chain, before = this.state(), { found } = this.motions();
    const back = (motion, point) => qRotate(qConjugate(motion.quat), plus(point, motion.shift, -1));
    const held = back(found[row], grip), { start } = this, poser = this;
    const links = [...chain].reverse().map((link) => {
      const { joint, frame } = this.frames[link], part = this.parts[link];
      const local = qMultiply(qMultiply(frame, before.turns[link]), qConjugate(frame));
      let { axis } = part;
      if (axis && part.parent >= 0) axis = qRotate(rigidFit(start, this.now, this.members[part.parent]).quat, axis);
      return { joint, quat: local, shift: qRotate(frame, before.shifts[link]), axis, frame, row: link };
    });
    const above = this.parts[chain[chain.length - 1]].parent;
    return (where) => {
      poser.turns = [...before.turns];
      poser.shifts = [...before.shifts];
      poser.version++;
      if (poser.parts[row].parent < 0) {
        const way = qRotate(qConjugate(links[0].frame), plus(where, grip, -1));
        poser.shifts[row] = plus(before.shifts[row], way);
        return;
      }
      const pose = reach(links, above < 0 ? STILL : found[above], held, where);
      links.forEach((link, at) => {
        poser.turns[link.row] = qMultiply(qMultiply(qConjugate(link.frame), pose.turns[at]), link.frame);
      });
      poser.shifts[links[0].row] = qRotate(qConjugate(links[0].frame), pose.shift);
    };
  }
}
