// The page: time, camera, the worker that sorts, and frames when something has changed.

const SECONDS = 4; // a scene's whole time at speed 1, unless its facts say otherwise
const SLOW = 50; // milliseconds a frame: slower machines draw fewer pixels while something moves ...
const COARSEST = 0.4; // ... but not fewer than so many of each side's
const REST = 250; // milliseconds of stillness after which a frame is drawn in full
const LOST = "The graphics driver has dropped the picture; it comes back by itself as a rule. If not, reload the page.";
const BREAK = 3000; // milliseconds of rest between two movements

class Player {
  constructor(canvas, model) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: false, depth: false, alpha: false });
    if (!this.gl) throw new Error("WebGL 2 is missing");
    this.orbit = new Orbit(model.facts.overview);
    this.background = model.facts.background;
    this.follows = false; // the film's camera, if there is one
    this.time = 0;
    this.frames = 0;
    this.adaptive = true;
    this.coarse = 1; // share of each side's pixels that is drawn while something moves
    this.moving = false;
    this.rested = true; // nothing was to be drawn at the latest tick
    this.interval = SLOW / 2; // milliseconds between frames, of late
    this.drawn = 0;
    this.take(model);
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault(); // else it never comes back
      this.renderer = null;
      say(LOST);
    });
    canvas.addEventListener("webglcontextrestored", () => this.drawAgain());
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  // Show a model, in place of the present one if there is one.
  take(model) {
    this.model = model;
    this.figure = this.hand = null; // of pages in which parts are pulled
    this.table = new Float32Array(nodeWidth(model.facts) * Math.max(model.nodes, 1));
    this.stale = this.unsorted = true; // the picture, the order
    this.order = new Uint32Array(model.count);
    this.spare = new Uint32Array(model.count);
    this.amount = 0;
    this.worker?.terminate();
    this.startSorter();
    this.renderer?.dispose();
    this.renderer = this.gl.isContextLost() ? null : new Renderer(this.gl, model);
  }

  drawAgain() {
    try {
      this.renderer = new Renderer(this.gl, this.model);
    } catch (error) {
      say(error.message);
      return;
    }
    this.takeOrder(this.order, this.amount);
    say("");
  }

  get seconds() {
    return this.model.facts.seconds ?? SECONDS;
  }

  startSorter() {
    const { count, stride, nodes, means, indices, weights, shares, correctives } = this.model;
    const width = nodeWidth(this.model.facts), model = { count, stride, nodes, width, means, indices, weights, shares, correctives };
    this.sort = makeSorter(model);
    this.sorting = false;
    try {
      const text = `${SHARED.sort}\nserveSorter(self);`;
      const address = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
      this.worker = new Worker(address);
      URL.revokeObjectURL(address);
      this.worker.onmessage = ({ data }) => {
        this.sorting = false;
        this.spare = this.order;
        this.takeOrder(data.order, data.amount);
      };
      this.worker.onerror = () => this.sortHere();
      this.worker.postMessage({ model });
    } catch {
      this.worker = null; // a browser that allows none: sort here
    }
  }

  sortHere() {
    this.worker = null;
    this.sorting = false;
    this.spare ??= new Uint32Array(this.model.count);
    this.changed();
  }

  takeOrder(order, amount) {
    this.order = order;
    this.amount = amount;
    this.renderer?.setOrder(order, amount);
    this.stale = true;
  }

  changed() {
    this.stale = this.unsorted = true;
  }

  resize() {
    const { canvas } = this, share = this.moving ? this.coarse : 1, ratio = share * Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    this.stale = true;
    this.frame(); // at once: a resized canvas is blank
  }

  // Called for every frame of the screen.
  tick(now) {
    this.hand?.tick();
    if (this.stale) {
      const passed = now - this.drawn;
      this.moving = !this.rested || passed < BREAK; // a frame may take longer than a break
      this.rested = false;
      if (this.moving) this.interval += 0.2 * (Math.min(passed, 1.6 * SLOW) - this.interval); // one hitch is no trend
      if (this.adaptive && this.interval > SLOW && this.coarse > COARSEST) {
        this.coarse = Math.max(COARSEST, 0.8 * this.coarse);
        this.interval = SLOW / 2;
      }
      this.drawn = now;
      this.resize();
      this.frame();
    } else {
      this.rested = true;
      if (this.moving && now - this.drawn > Math.max(REST, 3 * this.interval)) {
        this.moving = false;
        this.resize();
      }
    }
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), 1);
    this.changed();
  }

  view() {
    const { width, height } = this.canvas, { path } = this.model.facts;
    if (this.follows && path) {
      const at = this.time * (path.length - 1), row = Math.min(Math.floor(at), path.length - 2), share = at - row;
      this.orbit.place(path[row].map((value, k) => value + share * (path[row + 1][k] - value)));
    }
    return normalised(this.orbit.camera(width, height), this.model.facts.normalisation);
  }

  requestOrder(view) {
    const row = view.rows[2], shift = view.shift[2];
    if (!this.worker) {
      this.unsorted = false;
      this.takeOrder(this.order, this.sort(row, shift, this.table, this.order));
    } else if (!this.sorting) {
      this.unsorted = false;
      this.sorting = true;
      const order = this.spare;
      this.spare = null;
      this.worker.postMessage({ row, shift, table: this.table, order }, [order.buffer]);
    }
  }

  // Poses of the control points at a time. exact: independent of what was shown before.
  pose(time, table, exact) {
    poseAt(this.model, time, table);
    this.figure?.apply(table, exact);
    if (this.hand) {
      const { nodes, facts } = this.model, { owner } = this.figure, { lit } = this.hand;
      for (let m = 0; m < nodes; m++) table[nodeWidth(facts) * m + 19] = !exact && owner[m] === lit ? 1 : 0;
    }
    return table;
  }

  // Draw if something has changed. Gaussians are where they belong at once; their order follows within a frame or two.
  frame() {
    if (!this.renderer || !this.stale) return;
    const view = this.view();
    this.pose(this.time, this.table, false);
    this.stale = false;
    if (this.unsorted) this.requestOrder(view);
    this.renderer.render(view, this.table, this.background, null);
    this.overlay?.draw(view);
    this.frames++;
  }

  // An exact frame in memory, sorted for this very view; what is on the screen stays.
  renderAt(time, viewmat, K, width, height, background) {
    if (!this.renderer) throw new Error(LOST);
    const view = normalised({ viewmat, K, width, height }, this.model.facts.normalisation);
    const table = this.pose(time, new Float32Array(this.table.length), true);
    const order = new Uint32Array(this.model.count);
    this.renderer.setOrder(order, this.sort(view.rows[2], view.shift[2], table, order));
    const pixels = this.renderer.read(view, table, background ?? this.background);
    this.takeOrder(this.order, this.amount);
    return { width, height, pixels };
  }
}
