// The editor's page: scene, tools, timeline, panel and commands together.

const HINTS = {
  pull: "Drag a part to pull it; drag beside the scene to turn the view. ? shows all keys.",
  turn: "Click a part, then drag a ring to turn it about its joint, or drag the dot in the middle to turn it about another point.",
  points: "Click to choose control points; Shift and drag (Control points > A drag: without Shift): lasso or brush, with Ctrl to remove; drag chosen ones to move them.",
};

const MOST_SENT = 2e6; // bytes of an edit file; quoted, they fit into one message

// The time of the film: real seconds, over its frames.
class FilmClock {
  constructor(player) {
    this.player = player;
    this.playing = false;
  }

  play(playing) {
    if (playing && !element("loop").checked && this.player.time >= 1) this.player.seek(0);
    this.playing = playing;
    this.last = performance.now();
    element("play").classList.toggle("on", playing);
    element("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  }

  hold(held) {
    this.held = held;
    this.last = performance.now();
  }

  tick(now) {
    if (!this.playing || this.held) return;
    const passed = Math.min(Math.max(now - this.last, 0), 250) / 1000;
    this.last = now;
    let time = this.player.time + (passed * Number(element("speed").value)) / this.player.seconds;
    if (time >= 1) {
      if (element("loop").checked) time %= 1;
      else this.play(false);
    }
    this.player.seek(time);
  }
}

class Studio {
  constructor() {
    this.holdFrame = "body";
    this.files = [];
    this.folder = "";
    this.link = new Link({
      hello: (hello) => this.greet(hello), camera: (camera) => this.film(camera), state: (state) => this.show(state), said: (said) => this.note(said.text, said.kind),
      file: ({ file, job }) => this.offer(file, job), parts: (parts) => this.know(parts), silent: (on) => this.silent(on), pose: () => this.player?.changed(),
      gone: (answers) => this.lost(answers), moved: () => this.anew(), picture: (jpeg) => (jpeg ? this.player?.take(jpeg) : this.player?.giveUp?.()),
    });
  }

  get name() {
    const plain = this.title.replace(/[^A-Za-z0-9 ._-]/g, "-").replace(/^[^A-Za-z0-9]+/, "");
    return plain.slice(0, 100).replace(/[. ]+$/, "") || "edit"; // as scgs_warp/editor/files.py takes names
  }

  greet(hello) {
    const { title, said, edges, files, folder } = hello;
    Object.assign(this, { title, files, folder, hello });
    this.edges = [];
    for (let k = 0; k < edges.length; k += 2) this.edges.push([edges[k], edges[k + 1]]);
    if (this.tools) this.tools.edges = this.edges;
    if (said && !this.greeted) this.note(said, "info");
    if (this.gone) this.found();
    this.greeted = true;
  }

  know(parts) {
    this.parts = parts;
    this.tools?.know(parts);
    if (this.link.state) this.panel?.show(this.link.state);
  }

  // The film's camera has changed.
  film(camera) {
    this.camera = camera;
    this.player?.film?.(camera);
  }

  lost(answers) {
    if (this.tools?.drag) this.tools.stop();
    this.player?.giveUp?.();
    const kept = this.link.state?.saved === false ? "Its last change may be lost." : "The edit is saved.";
    element("gone").textContent = answers ? `${STRANGE} The view is kept.`
      : `The server has gone. ${kept} Nothing can be edited until the server is started again; this page waits for it.`;
    element("gone").hidden = false;
    this.gone = true;
    element("status").textContent = "no server";
    element("status").className = "bad";
  }

  // The connection stands, but nothing comes: what was asked for waits, nothing else is sent.
  silent(on) {
    if (on) this.tools?.let?.();
    element("gone").textContent = `${SILENT} Nothing can be edited until it does; the view can still be turned.`;
    element("gone").hidden = !on;
    element("status").textContent = on ? "no answer" : "";
    element("status").className = on ? "bad" : "";
    if (!on && this.link.state) this.show(this.link.state);
  }

  found() {
    this.gone = false;
    element("gone").hidden = true;
    this.note("The server is back, with the edit that it has saved.", "info");
    if (this.tools) this.use(this.tools.kind);
    this.player?.changed();
  }

  // The server shows another scene, or is of another version.
  anew() {
    if (this.player) this.remember();
    location.reload();
  }

  async start() {
    say("Waiting for the server");
    await this.link.first;
    const canvas = element("view"), clock = this.clock = await this.open(canvas, asked.has("pictures"));
    const { player } = this;
    this.timeline = new Timeline(player, this.link, clock);
    const { kind = this.link.state.tool.parts_first ? "pull" : "points" } = this.restore();
    this.changes = new PartChanges(this);
    this.panel = new Panel(element("panel"), panelSections(this));
    this.commands = new Commands(this);
    listenToPointers(player);
    element("follow").addEventListener("change", () => followFilm(player, element("follow").checked));
    element("fold").addEventListener("click", () => this.fold());
    if (innerWidth <= 760) this.fold();
    addEventListener("pagehide", () => this.remember());
    this.listenToDrops();
    this.use(kind);
    this.show(this.link.state);
    const loop = (now) => {
      clock.tick(now);
      this.timeline.tick();
      player.tick(now);
      requestAnimationFrame(loop);
    };
    requestAnimationFrame(loop);
    if (player.renderer !== null) say("");
    return { player, clock, studio: this };
  }

  // Draw the scene here, or where that is impossible show the server's pictures.
  async open(canvas, pictures) {
    let why = pictures ? "The address asks for pictures of the server." : "";
    try {
      if (!pictures) requireBrowser();
    } catch (error) {
      why = error.message;
    }
    if (why) {
      this.player = new PicturePlayer(canvas, this.link, this.hello);
      this.tools = this.player.tools = new NoTools(this.link, this.parts);
      this.note(`${why} The server draws instead: parts are chosen by clicks and posed by the numbers in the panel.`, "info");
    } else {
      const report = (share) => say(`Loading ${Math.round(100 * share)} %`, share);
      this.player = new StudioPlayer(canvas, await readModel(await fetchedScene("scene", report)));
      this.player.link = this.link;
      this.tools = new Tools(this.player, this.link, this.parts);
      this.tools.edges = this.edges;
    }
    this.player.film(this.camera);
    this.player.clock = new FilmClock(this.player);
    return this.player.clock;
  }

  show(state) {
    if (!this.panel) return;
    const { player } = this, color = state.film.background ?? this.hello.background;
    if (JSON.stringify(color) !== this.painted) {
      this.painted = JSON.stringify(color);
      player.background = color;
    }
    this.timeline.show(state);
    this.panel.show(state);
    this.changes.show(state);
    this.commands.show();
    const status = element("status");
    status.className = state.problem ? "bad" : "";
    status.textContent = state.problem ? `not saved: ${state.problem}` : state.job ? `${state.job.name}: ${
      Math.round(state.job.percent)} %` : state.saved ? "saved" : "";
    player.changed();
  }

  note(text, kind = "error") {
    const row = document.createElement("li");
    row.className = kind;
    row.textContent = text;
    this.post(row);
  }

  post(row, stays = false) {
    element("notes").append(row);
    while (element("notes").children.length > 4) element("notes").firstChild.remove();
    if (!stays) {
      setTimeout(() => row.remove(), 9000);
      return;
    }
    const close = Object.assign(document.createElement("button"), { type: "button", textContent: "\u00d7", title: "Close this note" });
    close.setAttribute("aria-label", "Close this note");
    close.addEventListener("click", () => row.remove());
    row.append(close);
  }

  // An export takes a while, and nobody may look at its end: it is offered until the note is closed.
  offer(file, job, stays = true) {
    const row = document.createElement("li"), link = document.createElement("a");
    link.href = `file/${encodeURIComponent(file)}`;
    link.download = file;
    link.textContent = file;
    row.append(`${job} is done: `, link);
    this.post(row, stays);
  }

  use(kind) {
    this.tools.use(kind);
    for (const name of ["pull", "turn", "points"]) {
      document.querySelector(`[data-command="tool-${name}"]`).setAttribute("aria-pressed", String(name === kind));
    }
    element("hint").textContent = HINTS[kind];
  }

  display(name, on) {
    this.tools.show[name] = on;
    this.player.stale = true;
    this.panel.show(this.link.state);
  }

  compare(on) {
    if (Boolean(this.player.original) === on) return;
    this.player.original = on;
    this.player.changed();
    element("hint").textContent = on ? "The scene without the edit; O shows the edit again." : HINTS[this.tools.kind];
  }

  paint(color) {
    this.player.background = color;
    this.player.stale = true;
    this.link.ask("film", { at: this.player.at, background: color });
  }

  theme(name) {
    document.body.classList.toggle("light", name === "light");
    this.panel.show(this.link.state);
  }

  fold() {
    const folded = document.body.classList.toggle("folded");
    element("fold").setAttribute("aria-expanded", String(!folded));
  }

  palette() {
    this.commands.open();
  }

  frame() {
    this.player.orbit.reset();
    followFilm(this.player, false);
  }

  // The view as the film's camera takes it.
  view() {
    const { azimuth, elevation, distance, target } = this.player.orbit, degrees = 180 / Math.PI;
    return { azimuth: azimuth * degrees, elevation: Math.min(80, Math.max(-80, elevation * degrees)), distance, target };
  }

  async save() {
    const answer = await this.link.ask("save", { at: this.player.at, name: this.name });
    if (answer.name) {
      this.files = answer.files;
      this.offer(answer.name, "The copy", false);
      this.panel.show(this.link.state);
    }
  }

  choose() {
    const input = Object.assign(document.createElement("input"), { type: "file", accept: ".json,application/json" });
    input.addEventListener("change", () => this.send(input.files));
    input.click();
  }

  // Load an edit file that was chosen, or dropped on the page.
  async send([file, ...others]) {
    if (!file) return;
    if (others.length) this.note("One edit at a time: drop a single file.");
    else if (file.size > MOST_SENT) this.note(`${file.name} is too large to be sent; put it into ${this.folder} and choose it there.`);
    else {
      const text = await file.text().catch(() => null); // a folder has none
      if (text === null) this.note(`${file.name} cannot be read; drop an edit's JSON.`);
      else if (!(await this.link.ask("upload", { text })).problem) this.note(`${file.name} is loaded; undo brings the other edit back.`, "info");
    }
  }

  // A browser would leave the page for a file that is dropped on it.
  listenToDrops() {
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => {
      event.preventDefault();
      this.send(event.dataTransfer.files);
    });
  }

  share() {
    this.link.ask("export_page", { at: this.player.at, name: this.name, pose: true });
  }

  picture() {
    const { player } = this, { canvas } = player;
    if (!player.renderAt) return this.download(canvas);
    if (!player.renderer) return this.note(LOST);
    const view = player.orbit.camera(canvas.width, canvas.height);
    const { width, height, pixels } = player.renderAt(player.time, view.viewmat, view.K, view.width, view.height);
    const drawn = Object.assign(document.createElement("canvas"), { width, height });
    drawn.getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
    this.download(drawn);
  }

  download(canvas) {
    canvas.toBlob((blob) => {
      const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: `${this.name}.png` });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
  }

  // What a reload brings back: the view, the moment, the tool, and what is shown.
  remember() {
    const { azimuth, elevation, distance, target } = this.player.orbit;
    const kept = { azimuth, elevation, distance, target, time: this.player.time, show: this.tools.show, kind: this.tools.kind,
      light: document.body.classList.contains("light") };
    try {
      sessionStorage.setItem(`editor ${this.title}`, JSON.stringify(kept));
    } catch { /* a browser that keeps nothing */ }
  }

  restore() {
    try {
      const kept = JSON.parse(sessionStorage.getItem(`editor ${this.title}`));
      if (!kept) return {};
      const { azimuth, elevation, distance, target, time, show, light } = kept;
      Object.assign(this.player.orbit, { azimuth, elevation, distance, target });
      Object.assign(this.tools.show, show);
      this.player.seek(time);
      document.body.classList.toggle("light", Boolean(light));
      return kept;
    } catch { // nothing usable was kept
      return {};
    }
  }
}

const studio = new Studio(), started = studio.start();
started.catch(() => { studio.link.wire.broken = true; });
publish(started);
