// The strip below the picture: one track a part or handle, keyframes as diamonds that are dragged, copied and deleted.

class Timeline {
  constructor(player, link, clock) {
    Object.assign(this, { player, link, clock });
    this.place = element("tracks");
    this.chosen = null; // { name (null: all), at }
    this.scrubbed = (event) => {
      if (event.type === "pointerdown") {
        if (event.target.classList.contains("key")) return;
        event.currentTarget.setPointerCapture(event.pointerId);
      } else if (!event.currentTarget.hasPointerCapture(event.pointerId)) return;
      clock.play(false);
      player.seek(this.share(event));
    };
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
    const key = JSON.stringify([names, state.keyframes, state.film, this.chosen, state.active]);
    if (key === this.shown) return;
    this.shown = key;
    const rows = [["Film", null], ...names.map((name) => [label(name), name])];
    place.replaceChildren(...rows.flatMap(([text, name]) => {
      const title = document.createElement("button");
      title.type = "button";
      title.className = "name";
      title.textContent = text;
      title.disabled = name === null;
      title.addEventListener("click", () => this.link.ask("activate", { name, at: this.player.at }));
      const lane = document.createElement("div");
      lane.className = name === null ? "lane ruler" : "lane";
      if (name === null) this.addMarks(lane, state);
      for (const type of ["pointerdown", "pointermove"]) lane.addEventListener(type, this.scrubbed);
      for (const frame of state.keyframes) {
        if (name === null || frame.names.includes(name)) lane.append(this.diamond(frame, name, state, text));
      }
      return [title, lane];
    }));
    this.head = document.createElement("div");
    this.head.id = "head";
    this.place.append(this.head);
    this.tick();
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
    button.className = "key";
    button.style.left = `${(100 * frame.at) / state.film.seconds}%`;
    button.setAttribute("aria-label", `Keyframe of ${name === null ? "all" : text} at ${frame.at.toFixed(2)} seconds`);
    button.title = "Drag to move, with Alt to copy; Delete removes it";
    const its = { name, at: frame.at };
    button.classList.toggle("chosen", this.chosen?.name === name && this.chosen?.at === frame.at);
    button.addEventListener("pointerdown", (event) => {
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
    button.addEventListener("keydown", (event) => {
      if (event.key === "Enter") this.choose(its);
      if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
        event.preventDefault();
        const to = Math.max(0, frame.at + (event.key === "ArrowLeft" ? -1 : 1) / state.film.fps);
        this.change("move", its, { to });
      }
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

  change(what, its, fields = {}) {
    this.shown = null;
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
