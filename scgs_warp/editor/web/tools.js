// The hand: what lies under the pointer lights up, a click takes it, a drag pulls it or turns it about its joint.

const CLICK = 4; // pixels that a click may move

class Tools {
  constructor(player, link, parts) {
    Object.assign(this, { player, link });
    this.kind = "pull"; // or turn, points
    this.lit = -1; // row of the part under the pointer
    this.show = { points: false, graph: false, bones: true, ribbons: false };
    this.local = false; // axes of the rings
    this.areas = false; // drags choose control points without Shift, which phones have not
    this.pivot = new Pivot(this);
    this.drag = null;
    player.tools = this;
    player.hand = this; // the player's own handlers ask it first
    this.overlay = player.overlay = new Overlay(player);
    this.gizmo = new Gizmo(this.overlay);
    this.overlay.items = () => this.draw();
    this.overlay.behind = 0.5 * player.model.facts.pose.edge_length;
    this.know(parts);
    const { canvas } = player;
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.end(event));
    canvas.addEventListener("pointerleave", () => this.drag || this.light(-1));
  }

  get state() {
    return this.link.state;
  }

  // The parts as the server has them at present, which may be other ones than when the page was loaded.
  know({ list, owner, chains }) {
    Object.assign(this, { parts: list, owner, chains });
    this.members = list.map((_, row) => [...owner.keys()].filter((m) => owner[m] === row));
    this.lit = -1;
    this.player.stale = true;
  }

  lights(m) {
    return this.kind !== "points" && this.lit >= 0 && this.owner[m] === this.lit;
  }

  light(row) {
    if (row === this.lit) return;
    this.lit = row;
    this.player.canvas.style.cursor = row < 0 ? "" : "grab";
    this.player.stale = true;
  }

  use(kind) {
    this.kind = kind;
    this.link.ask("tool", { parts_first: kind !== "points" });
    this.light(-1);
    this.player.stale = true;
  }

  // Units: the server's are those of the world.
  world(point) {
    const { centre, scale } = this.player.model.facts.normalisation;
    return point.map((value, k) => value / scale + centre[k]);
  }

  pixel({ clientX, clientY }) {
    const { canvas } = this.player, box = canvas.getBoundingClientRect();
    return [((clientX - box.left) * canvas.width) / box.width, ((clientY - box.top) * canvas.height) / box.height];
  }

  // In CSS pixels.
  spot({ clientX, clientY }) {
    const box = this.player.canvas.getBoundingClientRect();
    return [clientX - box.left, clientY - box.top];
  }

  surface(event) {
    const { player } = this;
    return player.renderer?.surface(player.view(), ...this.pixel(event)) ?? null;
  }

  nearest(place) {
    const { places } = this.player;
    let best = 0, least = Infinity;
    for (let m = 0; m < places.length / 3; m++) {
      const away = Math.hypot(places[3 * m] - place[0], places[3 * m + 1] - place[1], places[3 * m + 2] - place[2]);
      if (away < least) [best, least] = [m, away];
    }
    return best;
  }

  // A place of the canvas at a depth, in the units of the page.
  lift([x, y], depth) {
    const view = this.player.view(), [fx, fy, cx, cy] = view.lens;
    const seen = [((x - cx) / fx) * depth, ((y - cy) / fy) * depth, depth].map((v, k) => v - view.shift[k]);
    return [0, 1, 2].map((c) => view.rows.reduce((sum, row, r) => sum + row[c] * seen[r], 0));
  }

  // Called for every press: true keeps it from turning the view.
  takes(event, fingers) {
    if (this.drag || fingers || event.button !== 0 || !this.state || this.player.original || !this.link.open) return Boolean(this.drag && !this.drag.dropped);
    const { player } = this, spot = this.spot(event);
    const begin = (drag) => {
      player.canvas.setPointerCapture(event.pointerId);
      player.clock.hold(true); // what was pressed is where it was
      this.drag = { pointer: event.pointerId, from: event, moved: false, ...drag };
      return true;
    };
    if (this.kind === "turn" && !event.shiftKey && this.gizmo.onPivot(...spot)) return begin({ kind: "pivot" });
    const axis = this.gizmo.hit(...spot);
    if (axis >= 0 && !event.shiftKey) {
      return begin({ kind: "turn", turn: this.gizmo.turn(axis, ...spot), about: this.pivot.place() });
    }
    if (this.kind === "points" && (event.shiftKey || this.areas)) {
      const area = this.state.tool.region === "brush" ? new Brush(this, event) : new Lasso(this, event);
      const removes = event.ctrlKey || event.metaKey || (this.areas && this.state.tool.combine === "subtract");
      return begin({ kind: "area", area, how: removes ? "subtract" : "add" });
    }
    const point = this.surface(event);
    if (!point) {
      this.pressed = event;
      return false;
    }
    if (event.shiftKey && this.kind !== "points") return false;
    const view = player.view(), m = this.nearest(point);
    return begin({ kind: "pull", point, node: m, depth: dot(view.rows[2], point) + view.shift[2],
      how: event.ctrlKey || event.metaKey ? "subtract" : this.kind === "points" ? undefined : "replace" });
  }

  async move(event) {
    const { drag, player } = this;
    if (!drag) {
      if (event.pointerType === "mouse" && !event.buttons) this.wanted = event;
      return;
    }
    if (event.pointerId !== drag.pointer) return;
    if (!drag.moved) {
      if (Math.hypot(event.clientX - drag.from.clientX, event.clientY - drag.from.clientY) <= CLICK) return;
      drag.moved = true;
      if (drag.kind !== "pivot") this.grab(drag);
    }
    drag.latest = event;
    if (drag.kind === "pivot") this.pivot.put(event);
    else if (drag.area) drag.area.move(event);
    else if (drag.held) this.send(drag);
  }

  // Choose what is under the pointer unless it is chosen already, and take hold of it.
  async grab(drag) {
    const { player, state } = this, at = player.at;
    if (drag.area) return;
    if (drag.kind === "pull") {
      const row = this.owner[drag.node], chosen = this.kind === "points" && state.selection.includes(drag.node);
      if (!chosen && (this.kind === "points" || state.part !== this.parts[row].name)) {
        const answer = await this.link.ask("pick", this.picked(drag));
        if (answer.problem || drag.dropped) return this.stop();
      }
    }
    const answer = await this.link.ask("grab", { at });
    if (answer.problem || drag.dropped) {
      if (!answer.problem) this.link.ask("cancel", { at });
      return this.stop();
    }
    drag.held = true;
    if (drag.latest) this.send(drag);
    if (drag.over) this.finish(drag);
  }

  // A click with the points tool, where drags choose areas.
  click(event) {
    const point = this.surface(event);
    this.link.ask("pick", point ? this.picked({ point }) : { at: this.player.at, how: "replace" });
  }

  picked({ point, how }) {
    return { at: this.player.at, point: this.world(point), how, parts_first: this.kind !== "points" };
  }

  send(drag) {
    if (drag.kind === "turn") {
      const about = drag.about ? { about: this.world(drag.about) } : {};
      this.link.tell("drag", { rotation: drag.turn(...this.spot(drag.latest)), ...about });
    }
    else {
      const place = this.lift(this.pixel(drag.latest), drag.depth);
      this.link.tell("drag", { grip: this.world(drag.point), to: this.world(place) });
    }
  }

  end(event) {
    const { drag, pressed } = this;
    this.pressed = null;
    if (!drag) {
      if (pressed && Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY) <= CLICK) {
        this.link.ask("pick", { at: this.player.at, how: event.shiftKey ? "add" : "replace" });
      }
      return;
    }
    if (event.pointerId !== drag.pointer) return;
    if (drag.kind === "pivot") this.stop();
    else if (drag.area) {
      const nodes = drag.area.take(event);
      if (nodes.length) this.link.ask("select", { at: this.player.at, what: "nodes", nodes, how: drag.how });
      else if (!drag.moved && !event.shiftKey) this.click(event);
      this.stop();
    } else if (!drag.moved) {
      if (drag.kind === "pull") {
        this.link.ask("pick", this.picked(drag));
      }
      this.stop();
    } else if (drag.held) this.finish(drag);
    else drag.over = true; // as soon as the server has taken hold
  }

  finish(drag) {
    if (drag.latest) this.send(drag);
    this.link.ask("release", { at: this.player.at });
    this.stop();
  }

  stop() {
    this.drag = null;
    this.player.clock.hold(false);
    this.player.changed();
    clearLasso();
  }

  // The server does not answer: what is dragged stays where it is.
  let() {
    const { drag } = this;
    if (!drag) return;
    if (drag.held) this.finish(drag);
    else if (drag.moved && !drag.area && drag.kind !== "pivot") drag.over = true;
    else this.stop();
  }

  cancel() {
    const { drag } = this;
    if (!drag) {
      this.link.ask("pick", { at: this.player.at, how: "replace" });
      return;
    }
    drag.dropped = drag.moved && !drag.held && !drag.area && drag.kind !== "pivot";
    if (drag.dropped) return; // until the server has taken hold: its answer would end a drag that began meanwhile
    if (drag.held) this.link.ask("cancel", { at: this.player.at });
    this.stop();
  }

  // Once a frame: what the pointer is on.
  tick() {
    this.drag?.area?.tick?.();
    showFilmed(this.player);
    if (!this.wanted || this.drag || this.player.stale || !this.state) return;
    const event = this.wanted, onPivot = this.kind === "turn" && this.gizmo.onPivot(...this.spot(event));
    const ring = onPivot ? -1 : this.gizmo.hit(...this.spot(event));
    this.player.canvas.title = onPivot ? "Drag the pivot to where the rings should turn" : "";
    this.wanted = null;
    if (ring !== this.gizmo.lit) {
      this.gizmo.lit = ring;
      this.player.stale = true;
    }
    const point = ring < 0 ? this.surface(event) : null;
    showBrush(this, this.kind === "points" && this.state.tool.region === "brush" ? point : null);
    this.light(point ? this.owner[this.nearest(point)] : -1);
  }

  // Overlays

  node(m) {
    return Array.from(this.player.places.subarray(3 * m, 3 * m + 3));
  }

  joint(row, places = this.player.places) {
    const { quat, before, after: behind } = rigidFit(this.player.model.pose.start, places, this.members[row]);
    return plus(qRotate(quat, plus(this.parts[row].joint, before, -1)), behind);
  }

  draw() {
    const { state, overlay, show, player } = this;
    if (!state || !player.places || player.original) return;
    const chosen = this.drag?.area?.chosen(state.selection, this.drag.how) ?? new Set(state.selection), row = this.parts.findIndex((part) => part.name === state.part);
    const held = new Set(state.handles.filter((h) => !h.part).flatMap((h) => h.nodes)), pins = new Set(state.pins);
    if (show.graph) {
      for (const [a, b] of this.edges ?? []) overlay.line(this.node(a), this.node(b), 1, [0.6, 0.6, 0.65, 0.5]);
    }
    const points = show.points || this.kind === "points";
    for (let m = 0; m < player.model.nodes; m++) {
      if (!points && !(chosen.has(m) && row < 0)) continue;
      const color = chosen.has(m) ? [1, 0.75, 0, 1] : held.has(m) ? [0.24, 0.67, 1, 1]
        : pins.has(m) ? [0.6, 0.27, 0.27, 1] : [0.92, 0.92, 0.92, 0.85];
      overlay.point(this.node(m), chosen.has(m) ? 5 : 3.5, color);
    }
    if (show.ribbons) this.drawRibbons(chosen);
    if (show.bones && row >= 0) this.drawBones(row, state);
    this.placeGizmo(row, chosen);
    this.gizmo.draw();
  }

  // Joints of the chosen part's chain, and where they are without the edit.
  drawBones(row, state) {
    const { player } = this, chain = this.chains[row];
    const bones = (places, alpha, front) => {
      let last = rigidFit(player.model.pose.start, places, this.members[row]).after;
      for (const link of chain) {
        const joint = this.joint(link, places);
        this.overlay.line(last, joint, 2.5, [1, 1, 1, alpha], front);
        this.overlay.point(joint, 5, [1, 0.76, 0.29, alpha], front);
        last = joint;
      }
    };
    bones(player.places, 0.9, true);
    if (!state.unedited) bones(this.unedited(), 0.3, true);
  }

  // Control points of the scene without the edit, at the time shown.
  unedited() {
    const { player } = this, { model } = player, table = new Float32Array(nodeWidth(model.facts) * model.nodes);
    return player.placesIn(poseAt(model, sceneTime(this.state, player.at), table));
  }

  // Trained trajectories of the selection, or of some control points, from blue to red.
  drawRibbons(chosen) {
    const { model } = this.player, { samples, nodes } = model.facts, { rest, translation } = model.trajectories;
    const some = chosen.size ? [...chosen] : [...Array(nodes).keys()].filter((m) => m % Math.ceil(nodes / 40) === 0);
    const step = Math.max(1, Math.floor(samples / 32));
    for (const m of some.slice(0, 80)) {
      const at = (k) => [0, 1, 2].map((a) => rest[3 * m + a] + translation[3 * (samples * m + k) + a]);
      for (let k = 0; k + step < samples; k += step) {
        const share = k / samples;
        this.overlay.line(at(k), at(k + step), 2, [0.3 + 0.7 * share, 0.75 - 0.3 * share, 1 - 0.8 * share, 0.9]);
      }
    }
  }

  placeGizmo(row, chosen) {
    const { gizmo, kind } = this;
    gizmo.pivot = null;
    if (kind === "pull" || (row < 0 && !chosen.size)) return;
    const moved = this.pivot.place();
    if (moved) gizmo.pivot = moved;
    else if (row >= 0) gizmo.pivot = this.joint(row);
    else {
      const nodes = [...chosen];
      gizmo.pivot = nodes.reduce((sum, m) => plus(sum, this.node(m), 1 / nodes.length), [0, 0, 0]);
    }
    const axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    if (this.drag?.kind === "turn") return;
    const turn = this.local && row >= 0 ? rigidFit(this.player.model.pose.start, this.player.places, this.members[row]).quat
      : IDENTITY;
    gizmo.axes = axes.map((axis) => qRotate(turn, axis));
  }
}
