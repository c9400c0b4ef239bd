// The strip below the picture: one track a part or handle, keyframes as diamonds that are dragged, copied and deleted.

const CAMERA = Symbol("camera"); // in place of a handle's name
const SCRUBS = ["pointerdown", "pointermove", "pointerup"];

class Timeline {
  constructor(player, link, clock) {
    Object.assign(this, { player, link, clock });
    this.place = element("tracks");
    this.chosen = null; // { name (null: all), at }
    this.owed = 0; // frames by which arrows still move it
    this.scrubbed = (event) => {
      const { type, currentTarget: lane, clientX, clientY } = event;
      if (type === "pointerdown") {
        if (event.button !== 0 || event.target.classList.contains("key")) return; // a menu may swallow the release
        lane.setPointerCapture(event.pointerId);
        const scrolls = event.pointerType === "touch" && !lane.classList.contains("ruler");
        this.finger = scrolls ? [clientX, clientY] : null; // it may be about to scroll the tracks
        if (scrolls) return;
      } else if (!lane.hasPointerCapture(event.pointerId)) return;
      if (type === "pointermove" && this.finger) {
        const [across, along] = [clientX - this.finger[0], clientY - this.finger[1]].map(Math.abs);
        if (across <= Math.max(CLICK, along)) return;
        this.finger = null;
      }
      clock.play(false);
      player.seek(this.share(event));
    };
    document.addEventListener("keydown", (event) => {
      if (event.key !== "Escape" || !(this.moving || this.chosen) || document.querySelector("dialog[open]")) return;
      event.stopImmediatePropagation(); // it leaves what is chosen in the scene alone
      if (!this.moving) this.chosen = null;
      this.stay();
    });
  }

  // A key that was pressed is where it was.
  stay() {
    this.moving = this.shown = null;
    this.show(this.link.state);
  }

  share(event) {
    const box = this.place.querySelector(".ruler").getBoundingClientRect();
    return Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
  }

  // A moment of the film on a frame's time.
  second(event) {
    const { film } = this.link.state;
    return Math.min(Math.round(this.share(event) * film.seconds * film.fps) / film.fps, film.seconds);
  }

  show(state) {
    const { place } = this, names = [...new Set(state.keyframes.flatMap((frame) => frame.names))];
    for (const handle of state.handles) if (!names.includes(handle.name)) names.push(handle.name);
    const label = (name) => state.handles.find((handle) => handle.name === name)?.part ?? name;
    const key = JSON.stringify([names, names.map(label), state.keyframes, state.film, this.chosen, state.active, state.curve]);
    if (key === this.shown || this.moving) return; // a key that is pressed stays what it is
    this.shown = key;
    const rows = [["Film", null], ...names.map((name) => [label(name), name])], { views } = state.film;
    const lanes = rows.map(([text, name]) => {
      const title = document.createElement("button");
      title.type = "button";
      title.className = "name";
      title.textContent = text;
      title.dir = "auto";
      title.disabled = name === null;
      if (name !== null) Object.assign(title, { title: `${text}: double click for another name` }).dataset.handle = name;
      title.addEventListener("click", () => this.link.ask("activate", { name, at: this.player.at }));
      const lane = document.createElement("div");
      lane.className = name === null ? "lane ruler" : "lane";
      if (name === null) this.addMarks(lane, state);
      for (const type of SCRUBS) lane.addEventListener(type, this.scrubbed);
      for (const frame of state.keyframes) {
        if (name === null || frame.names.includes(name)) lane.append(this.diamond(frame, name, state, text));
      }
      if (name !== null && name === state.active && state.curve.length) {
        for (const one of [title, lane]) one.classList.add("tall");
        lane.append(...this.curve(state.curve));
      }
      return [title, lane];
    });
    if (views.length) lanes.splice(1, 0, this.cameraLane(state));
    const focused = place.contains(document.activeElement) ? document.activeElement.its : null;
    place.replaceChildren(...lanes.flat());
    if (focused) this.focus(focused);
    this.head = document.createElement("div");
    this.head.id = "head";
    this.head.style.height = `${place.scrollHeight}px`;
    this.place.append(this.head);
    if (state.active !== this.active) place.querySelector(".lane.tall")?.scrollIntoView({ block: "nearest" });
    this.active = state.active;
    this.tick();
  }

  // A key keeps the focus when the lanes are drawn anew, also where it was moved. A removed one leaves it to the nearest.
  focus({ name, at }) {
    const lane = [...this.place.querySelectorAll(".key")].filter(({ its }) => its.name === name);
    const away = ({ its }) => Math.abs(its.at - at), nearest = lane.sort((a, b) => away(a) - away(b))[0];
    const moved = lane.find((key) => key.classList.contains("chosen"));
    (nearest && away(nearest) === 0 ? nearest : moved ?? nearest)?.focus();
  }

  // Views of the film's camera, on a lane of their own.
  cameraLane(state) {
    const title = document.createElement("span"), lane = document.createElement("div");
    title.className = "name";
    title.textContent = "Camera";
    lane.className = "lane";
    for (const type of SCRUBS) lane.addEventListener(type, this.scrubbed);
    lane.append(...state.film.views.map((at) => this.diamond({ at }, CAMERA, state, "the camera")));
    return [title, lane];
  }

  // What the keys of a part add to its turn: about x, y and z, in the colours of the rings.
  curve(degrees) {
    const draw = (tag, attributes) => {
      const shape = document.createElementNS("http://www.w3.org/2000/svg", tag);
      for (const [name, value] of Object.entries(attributes)) shape.setAttribute(name, value);
      return shape;
    };
    const most = Math.max(10, ...degrees.flat().map(Math.abs)), last = degrees.length - 1;
    const svg = draw("svg", { viewBox: "0 0 100 100", preserveAspectRatio: "none", "aria-hidden": "true" });
    svg.append(draw("line", { x1: 0, x2: 100, y1: 50, y2: 50 }), ...AXIS_COLORS.map((color, axis) => draw("polyline", {
      stroke: hex(color), points: degrees.map((turn, k) => `${(100 * k) / last},${50 - (45 * turn[axis]) / most}`).join(" "),
    })));
    const scale = document.createElement("span");
    scale.className = "scale";
    scale.textContent = `turn, \u00b1${Math.round(most)}\u00b0`;
    return [svg, scale];
  }

  addMarks(lane, { film }) {
    const step = [0.1, 0.25, 0.5, 1, 2, 5, 10, 30, 60].find((value) => film.seconds / value <= 10) ?? 120;
    for (let at = 0; at <= film.seconds + 1e-9; at += step) {
      const mark = document.createElement("span");
      mark.textContent = `${Number(at.toFixed(2))} s`;
      mark.style.left = `${(100 * at) / film.seconds}%`;
      if (at < 0.97 * film.seconds) lane.append(mark);
    }
  }

  diamond(frame, name, state, text) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = name === CAMERA ? "key camera" : "key";
    const beyond = frame.at > state.film.seconds; // the film was made shorter
    button.classList.toggle("beyond", beyond);
    button.style.left = `${beyond ? 100 : (100 * frame.at) / state.film.seconds}%`;
    button.setAttribute("aria-label", `${name === CAMERA ? "View" : "Keyframe"} of ${name === null ? "all" : text} at ${frame.at.toFixed(2)} seconds`);
    button.title = `${beyond ? "After the end of the film. " : ""}Drag to move, with Alt to copy; Delete removes it`;
    const its = { name, at: frame.at };
    button.its = its;
    button.classList.toggle("chosen", this.chosen?.name === name && this.chosen?.at === frame.at);
    button.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.stopPropagation();
      button.setPointerCapture(event.pointerId);
      this.moving = { its, from: event.clientX, copy: event.altKey };
    });
    button.addEventListener("pointermove", (event) => {
      if (this.moving?.its !== its) return;
      this.moving.far ||= Math.abs(event.clientX - this.moving.from) > 3;
      if (this.moving.far) button.style.left = `${(100 * this.second(event)) / state.film.seconds}%`;
    });
    button.addEventListener("pointerup", (event) => {
      if (this.moving?.its !== its) return;
      const { far, copy } = this.moving;
      this.moving = null;
      if (!far) this.choose(its);
      else {
        const to = this.second(event);
        this.chosen = { name, at: to };
        this.change(copy ? "copy" : "move", its, { to });
      }
    });
    for (const name of ["pointercancel", "lostpointercapture"]) {
      button.addEventListener(name, () => {
        if (this.moving?.its === its) this.stay();
      });
    }
    button.addEventListener("keydown", (event) => {
      if (event.key === "Enter") this.choose(its);
      if (event.key === "Delete" || event.key === "Backspace") this.chosen = its; // for the command, which follows
      if (event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
      event.preventDefault();
      this.nudge(its, event.key === "ArrowLeft" ? -1 : 1);
    });
    return button;
  }

  choose(its) {
    this.chosen = its;
    this.clock.play(false);
    this.player.seek(its.at / this.player.seconds);
    this.shown = null;
    this.show(this.link.state);
  }

  // Moves a key by frames of the film. Those that are asked for before the answer follow it.
  async nudge({ name, at }, frames) {
    this.owed += frames;
    if (this.nudging) return;
    this.nudging = true;
    while (this.owed) {
      const to = Math.max(0, at + this.owed / this.link.state.film.fps);
      this.owed = 0;
      if (to === at) break;
      this.chosen = { name, at: to };
      if ((await this.change("move", { name, at }, { to })).problem) break;
      at = to;
    }
    this.owed = 0;
    this.nudging = false;
  }

  change(what, its, fields = {}) {
    this.shown = null;
    if (its.name === CAMERA) return this.link.ask("change_view", { what, from: its.at, ...fields });
    return this.link.ask("change_key", { what, from: its.at, ...(its.name === null ? {} : { name: its.name }), ...fields });
  }

  remove() {
    const { chosen } = this;
    this.chosen = null;
    return chosen ? this.change("delete", chosen) : null;
  }

  // The playhead.
  tick() {
    const { player, place } = this;
    const at = player.at, text = `${at.toFixed(2)} / ${player.seconds.toFixed(2)} s`;
    if (element("clock").value !== text) element("clock").value = text;
    const ruler = place.querySelector(".ruler");
    if (!ruler || !this.head) return;
    this.head.style.left = `${ruler.offsetLeft + player.time * ruler.offsetWidth}px`;
  }
}
