// What buttons, mouse, touch and keys do.

const element = (id) => document.getElementById(id);
const hex = (color) => "#" + color.map((v) => Math.round(255 * v).toString(16).padStart(2, "0")).join("");
const numbers = (text) => [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16) / 255);
const asked = new URLSearchParams(location.search); // of the page's address: ?noui, ?paused, ?t=SECONDS
const PINCH = 400; // milliseconds within which a second finger makes a pull a gesture of the view
const IDLE = 2500; // milliseconds without an input after which the bar hides while the scene plays

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

  // Stand still while a part is pulled.
  hold(held) {
    this.held = held;
    this.last = performance.now();
  }

  tick(now) {
    if (!this.playing || this.held) return;
    const { player } = this, ending = element("ending").value;
    const passed = Math.min(Math.max(now - this.last, 0), 250) / 1000; // a page that was hidden does not jump
    this.last = now;
    if (ending !== "back") this.direction = 1;
    let time = player.time + (this.direction * passed * Number(element("speed").value)) / player.seconds;
    if (ending === "again") time %= 1;
    else if (time > 1 || time < 0) {
      if (ending === "stop") this.play(false);
      else this.direction = time > 1 ? -1 : 1;
    }
    player.seek(time);
  }
}

function showTime(player) {
  const { seconds } = player, at = player.time * seconds;
  element("time").max = seconds;
  element("time").value = at;
  element("time").setAttribute("aria-valuetext", `${at.toFixed(2)} seconds`);
  const total = document.createElement("span");
  total.className = "total";
  total.textContent = ` / ${seconds.toFixed(2)}`;
  element("clock").replaceChildren(at.toFixed(2), total, " s");
  showCaption(player, at);
}

function showCaption(player, at) {
  const said = (player.model.facts.captions ?? []).find(({ from, to }) => at >= from && at < to);
  const text = said ? said.text : "", place = element("caption");
  if (place.textContent !== text) place.textContent = text;
  place.hidden = !text;
}

function setBackground(player, color) {
  player.background = color;
  player.stale = true;
  element("background").value = hex(color);
}

// One sheet at a time.
function toggleSheet(sheet, button) {
  const opens = element(sheet).hidden;
  for (const [other, its] of [["settings", "more"], ["keys", "help"]]) {
    element(other).hidden = !(opens && other === sheet);
    element(its).setAttribute("aria-expanded", String(opens && its === button));
  }
}

const toggleHelp = () => toggleSheet("keys", "help");

function toggleWhole() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => {});
}

function followFilm(player, follows) {
  player.follows = follows && Boolean(player.model.facts.path);
  element("follow").checked = player.follows;
  player.changed();
}

function listenToPanel(player, clock) {
  for (const form of [element("controls"), element("settings")]) {
    form.addEventListener("submit", (event) => event.preventDefault());
  }
  element("play").addEventListener("click", () => clock.play(!clock.playing));
  element("time").addEventListener("input", () => {
    clock.play(false);
    player.seek(Number(element("time").value) / player.seconds);
    showTime(player);
  });
  element("background").addEventListener("input", () => setBackground(player, numbers(element("background").value)));
  element("reset").addEventListener("click", () => resetView(player));
  element("more").addEventListener("click", () => toggleSheet("settings", "more"));
  element("help").addEventListener("click", toggleHelp);
  element("whole").addEventListener("click", toggleWhole);
  element("whole").hidden = !document.fullscreenEnabled;
  element("follow").addEventListener("change", () => followFilm(player, element("follow").checked));
}

// While the scene plays and nobody does anything, the picture is all there is.
function hideWhenIdle(clock) {
  let timer = 0;
  // What a click or a finger has left behind, focus and hovering, keeps nothing open.
  const busy = () => !clock.playing || !element("settings").hidden || !element("keys").hidden
    || (element("controls").matches(":hover") && matchMedia("(hover: hover)").matches)
    || Boolean(element("controls").querySelector(":focus-visible"));
  const wake = () => {
    document.body.classList.remove("idle");
    clearTimeout(timer);
    timer = setTimeout(() => (busy() ? wake() : document.body.classList.add("idle")), IDLE);
  };
  for (const name of ["pointermove", "pointerdown", "keydown", "wheel", "focusin"]) {
    document.addEventListener(name, wake, { passive: true });
  }
  wake();
}

function resetView(player) {
  player.orbit.reset();
  followFilm(player, true);
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
    if (player.follows) followFilm(player, false); // the view is the visitor's from here on
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
  // A second finger soon after the first one took a part: both mean the view, and the part goes back.
  const share = (event) => {
    const drag = player.hand?.drag;
    if (!drag || event.pointerType !== "touch" || drag.from.pointerType !== "touch") return;
    if (drag.moved && event.timeStamp - drag.from.timeStamp > PINCH) return;
    player.hand.cancel();
    const { pointerId, clientX, clientY } = drag.latest ?? drag.from;
    fingers.set(pointerId, { x: clientX, y: clientY });
  };
  canvas.addEventListener("pointerdown", (event) => {
    share(event);
    if (player.hand?.takes(event, fingers.size)) return; // it pulls a part of the scene
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
    if (player.follows) followFilm(player, false);
    const pixels = event.deltaY * [1, 33, 400][event.deltaMode];
    orbit.zoom(Math.exp(0.0015 * Math.min(Math.max(pixels, -400), 400)));
    player.changed();
  }, { passive: false });
}

// The page's name of a key that was pressed; null: the control that has the focus uses it itself. The slider's own steps
// are a thousandth of a second.
function pageKey({ key, target }) {
  const name = key.length === 1 ? key.toLowerCase() : key;
  if (target.type === "range") return { ArrowUp: "ArrowRight", ArrowDown: "ArrowLeft" }[name] ?? (/^Page/.test(name) ? null : name);
  const own = target.tagName === "SELECT" ? /^(?!Escape)/ : /^(INPUT|BUTTON)$/.test(target.tagName) ? /^( |Enter)$/ : null;
  return own?.test(name) ? null : name;
}

function closeSheets() {
  for (const [sheet, button] of [["settings", "more"], ["keys", "help"]]) {
    if (element(sheet).hidden) continue;
    if (element(sheet).contains(document.activeElement)) element(button).focus();
    toggleSheet(sheet, button);
  }
}

function listenToKeys(player, clock, further = {}) {
  const step = (by) => () => {
    clock.play(false);
    player.seek(player.time + by);
    showTime(player);
  };
  const turn = (azimuth, elevation) => () => player.orbit.turn(azimuth, elevation);
  const views = {
    "shift ArrowLeft": turn(-0.05, 0), "shift ArrowRight": turn(0.05, 0), ArrowUp: turn(0, 0.05),
    ArrowDown: turn(0, -0.05), "shift ArrowUp": turn(0, 0.05), "shift ArrowDown": turn(0, -0.05),
    "+": () => player.orbit.zoom(0.9), "=": () => player.orbit.zoom(0.9), "-": () => player.orbit.zoom(1 / 0.9),
  };
  const keys = {
    " ": () => clock.play(!clock.playing), ArrowLeft: step(-0.01), ArrowRight: step(0.01), Home: step(-1), End: step(1),
    Escape: closeSheets, r: () => resetView(player), h: toggleHelp, "?": toggleHelp, f: toggleWhole,
    c: () => followFilm(player, !player.follows),
    b: () => setBackground(player, player.background[0] < 0.5 ? [1, 1, 1] : [0, 0, 0]),
    ...further,
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const name = pageKey(event), view = (event.shiftKey && views["shift " + name]) || views[name];
    const act = view && (event.shiftKey || !keys[name]) ? view : keys[name];
    if (!act) return;
    event.preventDefault();
    if (act === view && player.follows) followFilm(player, false);
    act();
    player.changed();
  });
}
