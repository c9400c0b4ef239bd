// Farthest first. The same text runs in a worker, beside the page, and in the page where an exact frame is asked for.

// model: count, stride (neighbours a Gaussian, padded), nodes, width (numbers of a pose), means [N * 4], indices,
// weights [N * stride], shares, correctives [N * 28]
function makeSorter(model) {
  const { count, stride, nodes, width, means, indices, weights, shares, correctives } = model;
  const BINS = 4096; // 12 bits a pass, two passes: as fine as depths in float32 are over a scene
  const depths = new Float32Array(count), keys = new Uint32Array(count);
  const ids = new Uint32Array(count), half = new Uint32Array(count);
  const histogram = new Uint32Array(BINS);
  const planes = new Float64Array(4 * Math.max(nodes, 1));

  const layered = shares && width > 28; // data.js: the mask does not weaken handles
  const last = layered ? 28 : 0; // the map after which depth counts

  // Depth is linear in the position, and so it is under every control point's own map.
  function nodePlanes(row, shift, table) {
    for (let m = 0; m < nodes; m++) {
      for (let c = 0; c < 4; c++) {
        let sum = c === 3 ? shift : 0;
        for (let r = 0; r < 3; r++) sum += row[r] * table[width * m + last + 4 * r + c];
        planes[4 * m + c] = sum;
      }
    }
  }

  // Rotation matrix of the control points' blended quaternions at number `first` of their poses.
  function rotationOf(i, first, table, into) {
    const quat = [0, 0, 0, 0], reference = width * indices[stride * i] + first;
    for (let k = stride * i; k < stride * (i + 1); k++) {
      const at = width * indices[k] + first;
      let dot = 0;
      for (let a = 0; a < 4; a++) dot += table[at + a] * table[reference + a];
      const weight = dot < 0 ? -weights[k] : weights[k];
      for (let a = 0; a < 4; a++) quat[a] += weight * table[at + a];
    }
    const norm = Math.hypot(quat[0], quat[1], quat[2], quat[3]);
    const w = quat[0] / norm, x = quat[1] / norm, y = quat[2] / norm, z = quat[3] / norm;
    into[0] = 1 - 2 * (y * y + z * z), into[1] = 2 * (x * y - w * z), into[2] = 2 * (x * z + w * y);
    into[3] = 2 * (x * y + w * z), into[4] = 1 - 2 * (x * x + z * z), into[5] = 2 * (y * z - w * x);
    into[6] = 2 * (x * z - w * y), into[7] = 2 * (y * z + w * x), into[8] = 1 - 2 * (x * x + y * y);
  }

  // What a corrective adds to the position along an axis: as corrective() in splat.frag.glsl.
  const turn = new Float64Array(9), carried = new Float64Array(9);
  function correctiveAlong(i, row, table) {
    rotationOf(i, 12, table, carried);
    if (width > 20) rotationOf(i, 20, table, turn);
    else turn.set(carried);
    for (const k of [0, 4, 8]) turn[k] -= 1;
    let depth = 0;
    for (let a = 0; a < 3; a++) {
      let shift = 0;
      for (let k = 0; k < 9; k++) shift += correctives[28 * i + 9 * a + k] * turn[k];
      depth += shift * (row[0] * carried[a] + row[1] * carried[3 + a] + row[2] * carried[6 + a]);
    }
    return 0.1 * depth;
  }

  // Where the motion takes a Gaussian by its share, before handles do.
  const AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], moved = [0, 0, 0];
  function place(i, x, y, z, table) {
    for (let r = 0; r < 3; r++) {
      moved[r] = correctives ? correctiveAlong(i, AXES[r], table) : 0;
      for (let k = stride * i; k < stride * (i + 1); k++) {
        const at = width * indices[k] + 4 * r;
        moved[r] += weights[k] * (table[at] * x + table[at + 1] * y + table[at + 2] * z + table[at + 3]);
      }
      const rest = means[4 * i + r];
      moved[r] = rest + shares[i] * (moved[r] - rest);
    }
    return moved;
  }

  function pass(from, to, amount, bits) {
    histogram.fill(0);
    for (let j = 0; j < amount; j++) histogram[(keys[from[j]] >>> bits) & (BINS - 1)]++;
    let total = 0;
    for (let b = 0; b < BINS; b++) {
      const here = histogram[b];
      histogram[b] = total;
      total += here;
    }
    for (let j = 0; j < amount; j++) to[histogram[(keys[from[j]] >>> bits) & (BINS - 1)]++] = from[j];
  }

  // row, shift: third row of the world-to-camera matrix; table: of poseAt; order: Uint32Array [N] to be filled.
  // Returns how many Gaussians lie in front of the camera.
  return function sort(row, shift, table, order) {
    nodePlanes(row, shift, table);
    let amount = 0, least = Infinity, most = -Infinity;
    for (let i = 0; i < count; i++) {
      let x = means[4 * i], y = means[4 * i + 1], z = means[4 * i + 2], depth = 0;
      if (layered) [x, y, z] = place(i, x, y, z, table);
      if (nodes === 0 || shares) depth = row[0] * x + row[1] * y + row[2] * z + shift;
      if (nodes > 0) {
        let moved = 0;
        for (let k = stride * i; k < stride * (i + 1); k++) {
          const m = 4 * indices[k];
          moved += weights[k] * (planes[m] * x + planes[m + 1] * y + planes[m + 2] * z + planes[m + 3]);
        }
        if (correctives && !layered) moved += correctiveAlong(i, row, table);
        depth = shares && !layered ? depth + shares[i] * (moved - depth) : moved;
      }
      depth = Math.fround(depth); // as it is stored: the farthest must not lie beyond `most`
      if (!(depth >= 0.01)) continue;
      depths[i] = depth;
      half[amount++] = i;
      if (depth < least) least = depth;
      if (depth > most) most = depth;
    }
    const scale = most > least ? (BINS * BINS - 1) / (most - least) : 0;
    for (let j = 0; j < amount; j++) keys[half[j]] = (most - depths[half[j]]) * scale;
    pass(half, ids, amount, 0);
    pass(ids, order, amount, 12);
    return amount;
  };
}

function serveSorter(scope) {
  let sort = null;
  scope.onmessage = ({ data }) => {
    if (data.model) {
      sort = makeSorter(data.model);
      return;
    }
    const amount = sort(data.row, data.shift, data.table, data.order);
    scope.postMessage({ amount, order: data.order }, [data.order.buffer]);
  };
}
