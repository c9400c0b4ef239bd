// Reads what the page holds; docs/page.md describes it.

const WIDTH = 2048; // of all data textures

// Numbers of a control point's pose: three rows of the map x -> R (x - p) + p + t, the rotation of shapes, the change of
// log scales or the tint, and the glow; under an edit also the rotation that shading follows, and that of colours. With
// a mask, which weakens the motion but no handle, what handles do to the moved control point comes after that: three
// rows of a map, and its rotation.
const layered = (facts) => facts.edited && facts.masked;
const nodeWidth = (facts) => (layered(facts) ? 44 : facts.edited ? 28 : 20);

const mapped = (map, [x, y, z]) => [0, 4, 8].map((r) => map[r] * x + map[r + 1] * y + map[r + 2] * z + map[r + 3]);

// The map of control point m, rows as in a table of poses: motion, then handles.
function nodeMap(facts, table, m) {
  const row = nodeWidth(facts) * m, motion = table.subarray(row, row + 12);
  if (!layered(facts)) return motion;
  const handles = table.subarray(row + 28, row + 40), whole = new Float32Array(12);
  for (let c = 0; c < 4; c++) {
    const [x, y, z] = [motion[c], motion[4 + c], motion[8 + c]], w = c === 3 ? 1 : 0;
    for (const r of [0, 4, 8]) {
      whole[r + c] = handles[r] * x + handles[r + 1] * y + handles[r + 2] * z + handles[r + 3] * w;
    }
  }
  return whole;
}

// Columns are decoded when they are asked for, and not kept: codes of all of them take more memory than the scene.
class Columns {
  constructor(raw) {
    const length = new DataView(raw.buffer).getUint32(0, true);
    this.raw = raw;
    this.facts = JSON.parse(new TextDecoder().decode(raw.subarray(4, 4 + length)));
    this.places = {};
    let offset = 4 + length;
    for (const column of this.facts.columns) {
      this.places[column.name] = { ...column, offset };
      offset += column.rows * Math.ceil(column.bits / 8);
    }
  }

  // { codes, low, step }
  read(name) {
    const { rows, bits, low, step, delta, offset } = this.places[name];
    const codes = new Uint32Array(rows);
    for (let plane = 0; 8 * plane < bits; plane++) {
      const at = offset + plane * rows, shift = 8 * plane;
      for (let i = 0; i < rows; i++) codes[i] |= this.raw[at + i] << shift;
    }
    if (delta) {
      const mask = 2 ** bits - 1;
      for (let i = 1; i < rows; i++) codes[i] = (codes[i] + codes[i - 1]) & mask;
    }
    return { codes, low, step };
  }
}

// Values of several columns side by side, `stride` numbers a row, from number `first` of the row on.
function fill(target, stride, first, columns, names) {
  names.forEach((name, k) => {
    const { codes, low, step } = columns.read(name);
    for (let i = 0; i < codes.length; i++) target[stride * i + first + k] = low + step * codes[i];
  });
}

const numbered = (name, amount) => Array.from({ length: amount }, (_, k) => name + k);

// An array for `rows` rows of `stride` numbers in texels of four, filled up to whole lines of a texture.
function room(Type, rows, stride) {
  const texels = Math.ceil((rows * stride) / 4);
  return new Type(4 * WIDTH * Math.max(1, Math.ceil(texels / WIDTH)));
}

function readQuaternions(columns, target, stride) {
  const largest = columns.read("quat_largest").codes, count = largest.length, rest = new Float32Array(count).fill(1);
  for (let k = 0; k < 3; k++) {
    const { codes, low, step } = columns.read("quat" + k);
    for (let i = 0; i < count; i++) {
      const value = low + step * codes[i];
      rest[i] -= value * value;
      target[stride * i + ((largest[i] + 1 + k) & 3)] = value;
    }
  }
  for (let i = 0; i < count; i++) target[stride * i + largest[i]] = Math.sqrt(Math.max(rest[i], 0));
}

function readBinding(facts, columns, model) {
  const { count, stride, indices, weights } = model;
  for (let k = 0; k < facts.neighbors; k++) fill(indices, stride, k, columns, ["node" + k]);
  for (let k = 1; k < facts.neighbors; k++) fill(weights, stride, k, columns, ["weight" + k]);
  for (let i = 0; i < count; i++) {
    let first = 1; // weights sum to one
    for (let k = 1; k < facts.neighbors; k++) first -= weights[stride * i + k];
    weights[stride * i] = first;
  }
  if (facts.masked) {
    model.shares = new Float32Array(count);
    fill(model.shares, 1, 0, columns, ["share"]);
    fill(model.scales, 4, 3, columns, ["share"]);
  }
}

async function readHarmonics(facts, columns, model) {
  const coefficients = (facts.sh_degree + 1) ** 2 - 1, stride = 4 * Math.ceil(coefficients / 4);
  model.harmonics = room(Uint32Array, model.count, stride);
  model.shLow = new Float32Array(45);
  model.shStep = new Float32Array(45);
  for (let k = 0; k < coefficients; k++) {
    for (let c = 0; c < 3; c++) {
      const { codes, low, step } = columns.read(`sh${k}_${c}`);
      model.shLow[3 * k + c] = low;
      model.shStep[3 * k + c] = step;
      for (let i = 0; i < codes.length; i++) model.harmonics[stride * i + k] |= codes[i] << (8 * c);
    }
    await nextTurn();
  }
}

function readNodes(facts, columns) {
  const read = (name, width, rows) => {
    const values = new Float32Array(width * rows);
    fill(values, width, 0, columns, numbered(name, width));
    return values;
  };
  const rows = facts.nodes * facts.samples;
  return {
    rest: read("rest", 3, facts.nodes),
    translation: read("translation", 3, rows),
    rotation: read("rotation", 4, rows),
    shape: facts.shapes ? read("shape", 4, rows) : null,
    own: facts.turned ? read("own", 4, rows) : null,
    turn: facts.turned ? read("turn", 4, rows) : null,
    shift: facts.turned && facts.masked ? read("shift", 3, rows) : null,
    further: facts.turned && facts.masked ? read("further", 4, rows) : null,
    extra: facts.scaled ? read("log_scale", 3, rows) : facts.tinted ? read("tint", 3, rows) : null,
  };
}

// The part of every control point, where it is at time 0, and the edges between them.
function readParts(facts, columns) {
  const start = new Float64Array(3 * facts.nodes), codes = (name) => columns.read(name).codes;
  fill(start, 3, 0, columns, numbered("start", 3));
  return { owner: codes("part"), start, first: codes("edge0"), second: codes("edge1") };
}

// raw: the inflated bytes.
async function readModel(raw) {
  const columns = new Columns(raw), { facts } = columns;
  const count = facts.gaussians, stride = 4 * Math.ceil(facts.neighbors / 4);
  const colorStride = facts.shaded ? 16 : 4;
  const model = {
    facts, count, stride, nodes: facts.nodes, shares: null, correctives: null,
    means: room(Float32Array, count, 4),
    quats: room(Float32Array, count, 4),
    scales: room(Float32Array, count, 4),
    colors: room(Float32Array, count, colorStride),
    indices: room(Uint16Array, count, stride),
    weights: room(Float32Array, count, stride),
  };
  fill(model.means, 4, 0, columns, [...numbered("mean", 3), "opacity"]);
  await nextTurn();
  fill(model.scales, 4, 0, columns, numbered("scale", 3));
  fill(model.colors, colorStride, 0, columns, numbered("dc", 3));
  await nextTurn();
  if (facts.shaded) {
    fill(model.colors, colorStride, 3, columns, ["shading9"]);
    fill(model.colors, colorStride, 4, columns, numbered("shading", 9));
  }
  if (facts.corrected) {
    model.correctives = room(Float32Array, count, 28);
    fill(model.correctives, 28, 0, columns, numbered("corrective", 27));
  }
  await nextTurn();
  readQuaternions(columns, model.quats, 4);
  await readHarmonics(facts, columns, model);
  if (facts.nodes) {
    readBinding(facts, columns, model);
    model.trajectories = readNodes(facts, columns);
    if (facts.pose) model.pose = readParts(facts, columns);
  }
  return model;
}

const UNTURNED = [1, 0, 0, 0], UNMOVED = [0, 0, 0];

// Control points at a time in [0, 1], nodeWidth(facts) numbers each.
function poseAt(model, time, table) {
  const { nodes, facts, trajectories } = model;
  if (!nodes) return table;
  const last = facts.samples - 1, at = Math.min(Math.max(time, 0), 1) * last, width = nodeWidth(facts);
  const sample = Math.min(Math.floor(at), last - 1), share = facts.jumps?.includes(sample) ? 0 : at - sample;
  const quat = [0, 0, 0, 0];
  const blend = (values, size, m, into) => {
    const from = size * (facts.samples * m + sample);
    for (let a = 0; a < size; a++) into[a] = (1 - share) * values[from + a] + share * values[from + size + a];
  };
  const unit = (values, m) => {
    blend(values, 4, m, quat);
    const norm = Math.hypot(...quat);
    for (let a = 0; a < 4; a++) quat[a] /= norm;
  };
  const shift = [0, 0, 0], extra = [0, 0, 0], beyond = [0, 0, 0];
  for (let m = 0; m < nodes; m++) {
    const row = width * m, rest = trajectories.rest.subarray(3 * m, 3 * m + 3);
    unit(trajectories.rotation, m);
    blend(trajectories.translation, 3, m, shift);
    setMap(table, row, quat, rest, shift);
    if (trajectories.shape) unit(trajectories.shape, m);
    table.set(quat, row + 12);
    if (trajectories.extra) blend(trajectories.extra, 3, m, extra);
    table.set(extra, row + 16);
    if (!facts.edited) continue;
    if (trajectories.own) unit(trajectories.own, m);
    table.set(quat, row + 20);
    if (trajectories.turn) unit(trajectories.turn, m);
    table.set(trajectories.turn ? quat : UNTURNED, row + 24);
    if (!layered(facts)) continue;
    if (trajectories.further) {
      unit(trajectories.further, m);
      blend(trajectories.shift, 3, m, beyond);
    }
    const moved = shift.map((value, a) => value + rest[a]), further = trajectories.further ? quat : UNTURNED;
    setMap(table, row + 28, further, moved, trajectories.further ? beyond : UNMOVED);
    table.set(further, row + 40);
  }
  return table;
}

// The rows of x -> R (x - rest) + rest + shift.
function setMap(table, row, quat, rest, shift) {
  const rows = rotationRows(quat);
  for (let r = 0; r < 3; r++) {
    let offset = shift[r] + rest[r];
    for (let c = 0; c < 3; c++) {
      table[row + 4 * r + c] = rows[3 * r + c];
      offset -= rows[3 * r + c] * rest[c];
    }
    table[row + 4 * r + 3] = offset;
  }
}

function rotationRows([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}
