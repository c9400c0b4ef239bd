// Cameras as in scgs_warp/cameras.py: x right, y down, z forward; viewmat is world-to-camera. Angles in radians here.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, share = 1) => a.map((value, k) => value + share * b[k]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));

function horizon(up) {
  const helper = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  const zero = unit(plus(helper, up, -dot(helper, up)));
  return [zero, cross(up, zero)];
}

const STEEPEST = (89 * Math.PI) / 180; // above a pole, azimuth means nothing

class Orbit {
  constructor(overview) {
    this.overview = overview;
    this.reset();
  }

  reset() {
    const { centre, elevation, azimuth, radius } = this.overview;
    this.target = [...centre];
    this.elevation = (Math.min(Math.max(elevation, -80), 80) * Math.PI) / 180;
    this.azimuth = (azimuth * Math.PI) / 180;
    this.distance = radius;
  }

  // A row of facts.path: azimuth, elevation (degrees), distance, target.
  place([azimuth, elevation, distance, ...target]) {
    this.azimuth = (azimuth * Math.PI) / 180;
    this.elevation = (elevation * Math.PI) / 180;
    this.distance = distance;
    this.target = target;
  }

  turn(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = Math.min(Math.max(this.elevation + elevation, -STEEPEST), STEEPEST);
  }

  zoom(factor) {
    const { radius } = this.overview;
    this.distance = Math.min(Math.max(this.distance * factor, 0.02 * radius), 20 * radius);
  }

  // By pixels on a screen whose focal length is `focal` pixels.
  pan(dx, dy, focal) {
    const { viewmat } = this.camera(1, 1);
    const reach = this.distance / focal;
    this.target = plus(this.target, viewmat[0].slice(0, 3), -dx * reach);
    this.target = plus(this.target, viewmat[1].slice(0, 3), -dy * reach);
  }

  // Pixels: what the training images showed fits the window.
  focal(width, height) {
    const { fov_x, aspect } = this.overview;
    return Math.min(width, height * aspect) / (2 * Math.tan((fov_x * Math.PI) / 360));
  }

  camera(width, height) {
    const { up } = this.overview, [zero, ninety] = horizon(up);
    const aside = plus(zero.map((v) => v * Math.cos(this.azimuth)), ninety, Math.sin(this.azimuth));
    const outward = plus(aside.map((v) => v * Math.cos(this.elevation)), up, Math.sin(this.elevation));
    const eye = plus(this.target, outward, this.distance);
    const forward = outward.map((v) => -v), right = unit(cross(forward, up)), down = cross(forward, right);
    const viewmat = [right, down, forward].map((row) => [...row, -dot(row, eye)]);
    const focal = this.focal(width, height);
    return { viewmat: [...viewmat, [0, 0, 0, 1]], K: [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]],
      width, height };
  }
}

// What the shaders take: the camera that sees the scene in the units in which the page holds it.
function normalised(camera, { centre, scale }) {
  const rows = camera.viewmat.slice(0, 3).map((row) => row.slice(0, 3));
  const shift = camera.viewmat.slice(0, 3).map((row) => (row[3] + dot(row, centre)) * scale);
  const eye = [0, 1, 2].map((c) => -(rows[0][c] * shift[0] + rows[1][c] * shift[1] + rows[2][c] * shift[2]));
  const { K, width, height } = camera;
  return { rows, shift, eye, lens: [K[0][0], K[1][1], K[0][2], K[1][2]], width, height };
}
