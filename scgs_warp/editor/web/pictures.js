// The scene as the server's pictures, for browsers without WebGL 2: to look, play, click and edit by the panel.

const LONGEST = 900; // pixels of a picture's longer side

class PicturePlayer {
  constructor(canvas, link, hello) {
    this.canvas = canvas;
    this.link = link;
    this.facts = hello;
    this.orbit = new Orbit(hello.overview);
    this.model = { facts: { overview: hello.overview, normalisation: hello.normalisation, path: null }, nodes: 1 };
    this.background = hello.background;
    this.context = canvas.getContext("2d");
    this.time = 0;
    this.stale = true;
    this.waits = false;
    this.hand = { takes: (event, fingers) => this.press(event, fingers) };
    canvas.addEventListener("pointerup", (event) => this.click(event));
  }

  film({ overview }) {
    this.orbit.overview = { ...this.facts.overview, up: overview.up };
    this.changed();
  }

  get seconds() {
    return this.link.state?.film.seconds ?? SECONDS;
  }

  get fps() {
    return this.link.state?.film.fps ?? 30;
  }

  get at() {
    return this.time * this.seconds;
  }

  changed() {
    this.stale = true;
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), 1);
    this.changed();
  }

  camera() {
    const { clientWidth, clientHeight } = this.canvas, share = Math.min(1, LONGEST / Math.max(clientWidth, clientHeight, 1));
    return this.orbit.camera(Math.max(16, Math.round(clientWidth * share)), Math.max(16, Math.round(clientHeight * share)));
  }

  // One picture at a time: the newest view follows.
  tick() {
    if (!this.stale || this.waits || !this.link.open) return;
    this.stale = false;
    this.waits = true;
    this.link.tell("picture", { at: this.at, ...this.camera() });
  }

  // What was asked for does not come.
  giveUp() {
    this.waits = false;
  }

  async take(jpeg) {
    const picture = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
    this.canvas.width = picture.width;
    this.canvas.height = picture.height;
    this.context.drawImage(picture, 0, 0);
    this.waits = false;
  }

  press(event, fingers) {
    this.pressed = fingers || event.button !== 0 ? null : event;
    return false;
  }

  click(event) {
    const { pressed } = this, box = this.canvas.getBoundingClientRect();
    this.pressed = null;
    if (!pressed || Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY) > CLICK) return;
    const camera = this.camera(), share = camera.width / box.width;
    const pixel = [(event.clientX - box.left) * share, (event.clientY - box.top) * share];
    this.link.ask("pick_pixel", { at: this.at, pixel, how: event.shiftKey ? "add" : "replace", ...camera,
      parts_first: this.tools.kind !== "points" });
  }
}

// What the page's tools are where there is nothing to draw with.
class NoTools {
  constructor(link, parts) {
    Object.assign(this, { link });
    this.know(parts);
    this.show = { points: false, graph: false, bones: false, ribbons: false };
    this.local = false;
  }

  know({ list }) {
    this.parts = list;
  }

  use(kind) {
    this.kind = kind;
    this.link.ask("tool", { parts_first: kind !== "points" });
  }

  cancel() {
    this.link.ask("pick", { how: "replace" });
  }
}
