// Parts under the pointer: they light up, and a drag pulls them.

class Hand {
  constructor(player) {
    this.player = player;
    this.figure = new Figure(player.model);
    player.figure = this.figure;
    player.hand = this;
    this.lit = -1;
    this.past = [];
    const { canvas } = player;
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      canvas.addEventListener(name, (event) => this.release(event));
    }
    canvas.addEventListener("pointerleave", () => this.drag || this.light(-1));
    document.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.drag) this.cancel();
      if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") this.undo();
    });
  }

  // The part at a place of the window, with the point of its surface: { row, point }, or null.
  find(x, y) {
    const { player, figure } = this, { canvas } = player;
    const view = player.view(), scaleX = canvas.width / canvas.clientWidth, scaleY = canvas.height / canvas.clientHeight;
    const point = player.renderer?.surface(view, x * scaleX, y * scaleY);
    if (!point) return null;
    return { row: figure.owner[figure.nearest(point)], point };
  }

  light(row) {
    if (row === this.lit) return;
    this.lit = row;
    this.player.canvas.style.cursor = row < 0 ? "" : "grab";
    this.player.stale = true;
  }

  // Whether a press takes a part; the player's own handlers leave it alone then.
  takes(event, fingers) {
    if (this.drag || fingers || event.shiftKey || event.button !== 0) return Boolean(this.drag);
    const found = this.find(event.clientX, event.clientY);
    if (!found) return false;
    const { player, figure } = this, view = player.view();
    if (player.follows) followFilm(player, false);
    this.light(found.row);
    this.past.push(figure.state());
    player.canvas.setPointerCapture(event.pointerId);
    this.drag = { pointer: event.pointerId, go: figure.pull(found.row, found.point), moved: false, from: event,
      depth: dot(view.rows[2], found.point) + view.shift[2] };
    player.clock?.hold(true);
    return true;
  }

  // The place under the pointer at the depth of the drag.
  place({ clientX, clientY }) {
    const { player } = this, { canvas } = player, view = player.view(), [fx, fy, cx, cy] = view.lens, { depth } = this.drag;
    const seen = [((clientX * canvas.width) / canvas.clientWidth - cx) / fx * depth,
      ((clientY * canvas.height) / canvas.clientHeight - cy) / fy * depth, depth].map((v, k) => v - view.shift[k]);
    return [0, 1, 2].map((c) => view.rows.reduce((sum, row, r) => sum + row[c] * seen[r], 0));
  }

  move(event) {
    const { player, drag } = this;
    if (!drag) {
      if (event.pointerType === "mouse" && !event.buttons) this.wanted = event;
      return;
    }
    if (event.pointerId !== drag.pointer) return;
    drag.moved ||= Math.hypot(event.clientX - drag.from.clientX, event.clientY - drag.from.clientY) > 3;
    if (!drag.moved) return;
    drag.latest = event;
    drag.go(this.place(event));
    player.changed();
  }

  // Once a frame: what the pointer hovers over.
  tick() {
    if (!this.wanted || this.drag || this.player.stale) return;
    const { clientX, clientY } = this.wanted;
    this.wanted = null;
    this.light(this.find(clientX, clientY)?.row ?? -1);
  }

  release(event) {
    if (!this.drag || event.pointerId !== this.drag.pointer) return;
    if (!this.drag.moved) this.past.pop();
    this.end();
  }

  end() {
    this.drag = null;
    this.player.clock?.hold(false);
    this.player.changed();
    element("restore").disabled = !this.figure.posed;
  }

  cancel() {
    this.figure.restore(this.past.pop());
    this.end();
  }

  undo() {
    if (this.drag || !this.past.length) return;
    this.figure.restore(this.past.pop());
    this.end();
  }

  restore() {
    if (!this.figure.posed) return;
    this.past.push(this.figure.state());
    this.figure.reset();
    this.end();
  }
}

function posable(player, clock) {
  if (!player.model.pose) return {};
  player.clock = clock;
  const hand = new Hand(player);
  element("restore").hidden = false;
  element("restore").addEventListener("click", () => hand.restore());
  for (const row of document.querySelectorAll(".posing")) row.hidden = false;
  return { p: () => hand.restore() };
}
