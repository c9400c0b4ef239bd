// What buttons, mouse, touch and keys do.

const element = (id) => document.getElementById(id);
const hex = (color) => "#" + color.map((v) => Math.round(255 * v).toString(16).padStart(2, "0")).join("");
const numbers = (text) => [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16) / 255);

class Clock {
  constructor(player) {
    this.player = player;
    this.playing = false;
    this.direction = 1;
    this.last = 0;
  }

  play(playing) {
    const { player } = this;
    this.playing = playing && player.model.nodes > 0;
    if (this.playing && element("ending").value === "stop" && player.time >= 1) player.seek(0);
    element("play").classList.toggle("on", this.playing);
    element("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
    this.last = performance.now();
  }

  tick(now) {
    if (!this.playing) return;
    const { player } = this, ending = element("ending").value;
    const passed = Math.min(Math.max(now - this.last, 0), 250) / 1000; // a page that was hidden does not jump
    this.last = now;
    if (ending !== "back") this.direction = 1;
    let time = player.time + (this.direction * passed * Number(element("speed").value)) / SECONDS;
    if (ending === "again") time %= 1;
    else if (time > 1 || time < 0) {
      if (ending === "stop") this.play(false);
      else this.direction = time > 1 ? -1 : 1;
    }
    player.seek(time);
  }
}

function showTime(player) {
  element("time").value = player.time;
  element("clock").value = player.time.toFixed(3);
}

function setBackground(player, color) {
  player.background = color;
  player.stale = true;
  element("background").value = hex(color);
}

function listenToPanel(player, clock) {
  element("controls").addEventListener("submit", (event) => event.preventDefault());
  element("play").addEventListener("click", () => clock.play(!clock.playing));
  element("time").addEventListener("input", () => {
    clock.play(false);
    player.seek(Number(element("time").value));
    showTime(player);
  });
  element("background").addEventListener("input", () => setBackground(player, numbers(element("background").value)));
  element("reset").addEventListener("click", () => resetView(player));
  element("help").addEventListener("click", toggleHelp);
}

function resetView(player) {
  player.orbit.reset();
  player.changed();
}

function toggleHelp() {
  const keys = element("keys");
  keys.hidden = !keys.hidden;
  element("help").setAttribute("aria-expanded", String(!keys.hidden));
}

function listenToPointers(player) {
  const { canvas, orbit } = player, fingers = new Map();
  const middle = () => {
    const all = [...fingers.values()];
    return { x: all.reduce((sum, p) => sum + p.x, 0) / all.length, y: all.reduce((sum, p) => sum + p.y, 0) / all.length,
      spread: all.length > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 0 };
  };
  const move = (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = middle();
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const after = middle(), dx = after.x - before.x, dy = after.y - before.y;
    if (fingers.size > 1 || event.shiftKey || event.buttons & 6) {
      orbit.pan(dx, dy, orbit.focal(canvas.clientWidth, canvas.clientHeight));
      if (before.spread > 0 && after.spread > 0) orbit.zoom(before.spread / after.spread);
    } else {
      const turn = Math.PI / Math.max(300, Math.min(canvas.clientWidth, canvas.clientHeight));
      orbit.turn(-turn * dx, turn * dy);
    }
    player.changed();
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", move);
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const pixels = event.deltaY * [1, 33, 400][event.deltaMode];
    orbit.zoom(Math.exp(0.0015 * Math.min(Math.max(pixels, -400), 400)));
    player.changed();
  }, { passive: false });
}

function listenToKeys(player, clock) {
  const step = (by) => () => {
    clock.play(false);
    player.seek(player.time + by);
    showTime(player);
  };
  const turn = (azimuth, elevation) => () => player.orbit.turn(azimuth, elevation);
  const keys = {
    " ": () => clock.play(!clock.playing), ArrowLeft: step(-0.01), ArrowRight: step(0.01), Home: step(-1), End: step(1),
    "shift ArrowLeft": turn(-0.05, 0), "shift ArrowRight": turn(0.05, 0), ArrowUp: turn(0, 0.05),
    ArrowDown: turn(0, -0.05), "shift ArrowUp": turn(0, 0.05), "shift ArrowDown": turn(0, -0.05),
    "+": () => player.orbit.zoom(0.9), "=": () => player.orbit.zoom(0.9), "-": () => player.orbit.zoom(1 / 0.9),
    r: () => player.orbit.reset(), h: toggleHelp,
    b: () => setBackground(player, player.background[0] < 0.5 ? [1, 1, 1] : [0, 0, 0]),
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (/^(select|input|button)$/i.test(event.target.tagName)) return; // they have keys of their own
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const act = (event.shiftKey && keys["shift " + name]) || keys[name];
    if (!act) return;
    event.preventDefault();
    act();
    player.changed();
  });
}
