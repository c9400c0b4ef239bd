// Three rings about a joint, of a fixed size on the screen, whose drag turns.

const RING = 78; // pixels
const GRAB = 9; // pixels beside a ring that still take it
const SEGMENTS = 64;
const AXIS_COLORS = [[1, 0.35, 0.35], [0.45, 0.9, 0.4], [0.4, 0.6, 1]];

class Gizmo {
  constructor(overlay) {
    this.overlay = overlay;
    this.pivot = null; // in the units of the page
    this.axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    this.lit = -1;
  }

  // Ring radius in the units of the page, so that it has RING pixels on the screen.
  get radius() {
    const { view, scale } = this.overlay, z = dot(view.rows[2], this.pivot) + view.shift[2];
    return (RING * scale * Math.max(z, 0.01)) / view.lens[0];
  }

  ring(axis) {
    const [u, v] = [1, 2].map((k) => this.axes[(axis + k) % 3]), { radius, pivot } = this, points = [];
    for (let k = 0; k <= SEGMENTS; k++) {
      const angle = (2 * Math.PI * k) / SEGMENTS;
      points.push(plus(plus(pivot, u, radius * Math.cos(angle)), v, radius * Math.sin(angle)));
    }
    return points;
  }

  draw() {
    if (!this.pivot) return;
    for (let axis = 0; axis < 3; axis++) {
      const points = this.ring(axis), alpha = this.lit === axis ? 1 : 0.8;
      for (let k = 0; k < SEGMENTS; k++) {
        this.overlay.line(points[k], points[k + 1], this.lit === axis ? 4 : 2.5, [...AXIS_COLORS[axis], alpha], true);
      }
    }
    this.overlay.point(this.pivot, 5, [1, 1, 1, 1], true);
  }

  // The ring at a place of the canvas (canvas pixels), -1: none.
  hit(x, y) {
    if (!this.pivot) return -1;
    let best = -1, least = GRAB * this.overlay.scale;
    for (let axis = 0; axis < 3; axis++) {
      const seen = this.ring(axis).map((point) => this.overlay.project(point));
      for (let k = 0; k < SEGMENTS; k++) {
        const [a, b] = [seen[k], seen[k + 1]];
        if (!a || !b) continue;
        const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
        const share = Math.min(1, Math.max(0, ((x - a[0]) * dx + (y - a[1]) * dy) / (dx * dx + dy * dy || 1)));
        const away = Math.hypot(x - a[0] - share * dx, y - a[1] - share * dy);
        if (away < least) [best, least] = [axis, away];
      }
    }
    return best;
  }

  // Begin to turn; the result maps a place of the canvas to a quaternion since the beginning.
  turn(axis, x, y) {
    const { overlay, pivot } = this, direction = this.axes[axis], { view } = overlay;
    const centre = overlay.project(pivot), towards = dot(plus(view.eye, pivot, -1), direction);
    const sign = towards >= 0 ? -1 : 1; // seen from the front, an angle on the screen runs the other way
    const angleAt = (px, py) => Math.atan2(py - centre[1], px - centre[0]);
    const flat = Math.abs(towards) / Math.hypot(...plus(view.eye, pivot, -1)) < 0.2, start = angleAt(x, y);
    const side = overlay.project(plus(pivot, direction, this.radius)) ?? centre;
    const along = [-(side[1] - centre[1]), side[0] - centre[0]], size = Math.hypot(...along) || 1;
    let turned = 0, last = start;
    return (px, py) => {
      if (flat) turned = ((px - x) * along[0] + (py - y) * along[1]) / size / (RING * overlay.scale);
      else {
        const now = angleAt(px, py);
        turned += sign * Math.atan2(Math.sin(now - last), Math.cos(now - last));
        last = now;
      }
      return qExponential(direction.map((value) => value * turned));
    };
  }
}
