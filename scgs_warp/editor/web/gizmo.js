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

  // Where a point is seen, in CSS pixels of the canvas, whose own pixels may become fewer during a drag.
  seen(point) {
    const { overlay } = this, place = overlay.project(point);
    return place && [place[0] / overlay.scale, place[1] / overlay.scale];
  }

  // Whether a place of the canvas in CSS pixels is on the dot in the middle.
  onPivot(x, y) {
    const seen = this.pivot && this.seen(this.pivot);
    return Boolean(seen) && Math.hypot(x - seen[0], y - seen[1]) < GRAB;
  }

  // The ring at a place of the canvas in CSS pixels, -1: none.
  hit(x, y) {
    if (!this.pivot) return -1;
    let best = -1, least = GRAB;
    for (let axis = 0; axis < 3; axis++) {
      const seen = this.ring(axis).map((point) => this.seen(point));
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

  // Begin to turn at a place in CSS pixels; the result maps a later place to a quaternion since the beginning.
  turn(axis, x, y) {
    const { pivot, radius } = this, direction = this.axes[axis], centre = this.seen(pivot) ?? [x, y];
    // Where a step along an axis of the space leads on the screen.
    const step = (along) => {
      const seen = this.seen(plus(pivot, along, radius)) ?? centre;
      return [seen[0] - centre[0], seen[1] - centre[1]];
    };
    const [u, v] = [1, 2].map((k) => step(this.axes[(axis + k) % 3])), area = u[0] * v[1] - u[1] * v[0];
    // The angle along the ring, whose ellipse on the screen is undone.
    const angleAt = (px, py) => {
      const [dx, dy] = [px - centre[0], py - centre[1]];
      return Math.atan2((u[0] * dy - u[1] * dx) / area, (dx * v[1] - dy * v[0]) / area);
    };
    const flat = Math.abs(area) < 0.2 * RING * RING, start = flat ? 0 : angleAt(x, y);
    const side = step(direction), along = [-side[1], side[0]], length = Math.hypot(...along) || 1;
    let turned = 0, last = start;
    return (px, py) => {
      if (flat) turned = ((px - x) * along[0] + (py - y) * along[1]) / length / RING;
      else {
        const now = angleAt(px, py);
        turned += Math.atan2(Math.sin(now - last), Math.cos(now - last));
        last = now;
      }
      return qExponential(direction.map((value) => value * turned));
    };
  }
}
