// The server's state and poses, and what is asked of it.

const AHEAD = 24; // frames that are asked for while the film plays
const NO_SERVER = "there is no server at present";
const KINDS = { pose: 1, picture: 2 };

class Link {
  constructor(listener) {
    this.listener = listener; // hello, parts, camera, state, said, file, pose, gone, moved, silent
    this.state = null;
    this.live = null; // pose of a drag
    this.cache = new Map(); // frame -> pose
    this.asked = new Set();
    this.waiting = new Map();
    this.count = 0;
    this.missing = new Set(["hello", "parts", "camera", "state"]);
    this.first = new Promise((resolve) => { this.arrived = resolve; }); // all of these have come
    const heard = (data) => (typeof data === "string" ? this.hear(JSON.parse(data)) : this.take(data));
    this.wire = new Wire(heard, (answers) => this.gone(answers), () => this.listener.moved(),
      (on) => this.listener.silent(on));
  }

  get open() {
    return this.wire.open && !this.wire.quiet;
  }

  gone(answers) {
    this.forget();
    for (const { answer } of this.waiting.values()) answer({ problem: NO_SERVER });
    this.waiting.clear();
    this.listener.gone(answers);
  }

  forget() {
    this.cache.clear();
    this.asked.clear();
  }

  hear(message) {
    if (message.hello) this.listener.hello(message.hello);
    if (message.parts) this.listener.parts(message.parts);
    if (message.state) {
      const before = this.state;
      this.state = message.state;
      if (!before || before.version !== this.state.version) this.forget();
      if (!this.state.dragging) this.live = null;
      this.listener.state(this.state, before);
    }
    if (message.camera) this.listener.camera(message.camera);
    for (const kind of [...this.missing]) if (message[kind]) this.missing.delete(kind);
    if (!this.missing.size) this.arrived();
    if (message.said) this.listener.said(message.said);
    if (message.file) this.listener.file(message);
    if (message.undrawn) this.listener.picture(null);
    if (message.done) {
      const asker = this.waiting.get(message.id);
      this.waiting.delete(message.id);
      if (message.problem && !asker?.shows) this.listener.said({ text: message.problem, kind: "error" });
      asker?.answer(message);
    }
  }

  take(data) {
    const [kind, version, frame] = new Int32Array(data, 0, 4);
    if (kind === KINDS.picture) return void this.listener.picture(data.slice(16));
    if (kind !== KINDS.pose) return;
    const table = new Float32Array(data, 16);
    if (frame < 0) this.live = table;
    else if (version === this.state?.version) {
      this.cache.set(frame, table);
      this.asked.delete(frame);
    }
    this.listener.pose();
  }

  // Resolves with the server's answer. shows: whoever asks shows the problem that it may have.
  ask(what, fields = {}, shows = false) {
    if (!this.open) return Promise.resolve({ problem: NO_SERVER });
    const id = ++this.count;
    this.wire.send({ do: what, id, ...fields });
    return new Promise((answer) => this.waiting.set(id, { answer, shows }));
  }

  // Without an answer, for what is sent many times a second.
  tell(what, fields) {
    if (this.open) this.wire.send({ do: what, ...fields });
  }

  // The pose of a frame, or null until it comes; frames ahead are asked for as well.
  poseOf(frame, frames, ahead) {
    const wanted = [];
    for (let k = 0; k <= (ahead ? AHEAD : 0); k++) {
      const next = (frame + k) % frames;
      if (!this.cache.has(next) && !this.asked.has(next)) wanted.push(next);
    }
    if (this.open && wanted.length && (wanted[0] === frame || wanted.length > AHEAD / 2)) {
      for (const next of wanted) this.asked.add(next);
      this.tell("frames", { version: this.state.version, frames: wanted });
    }
    return this.cache.get(frame) ?? null;
  }
}

// Scene time at a second of the film: scgs_warp/edit/playback.py.
function sceneTime({ playback, film }, at) {
  if (playback.freeze !== null) return playback.freeze;
  if (playback.map.length) {
    const { map } = playback, next = map.findIndex(([second]) => second >= at);
    if (next <= 0) return map[next < 0 ? map.length - 1 : 0][1];
    const [a, b] = [map[next - 1], map[next]];
    return a[1] + ((at - a[0]) / (b[0] - a[0])) * (b[1] - a[1]);
  }
  const seconds = playback.seconds ?? film.seconds;
  let phase = playback.start + (seconds > 0 ? (Math.abs(playback.speed) * at) / seconds : 0);
  if (playback.repeat === "loop") phase -= Math.floor(phase);
  if (playback.repeat === "swing") phase = 1 - Math.abs((phase % 2) - 1);
  phase = Math.min(Math.max(phase, 0), 1);
  return playback.speed < 0 ? 1 - phase : phase;
}
