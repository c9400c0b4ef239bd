// Start a page, or say in words why not.

function say(text, share = null) {
  element("said").textContent = text;
  element("message").hidden = !text;
  element("loading").hidden = share === null;
  if (share !== null) element("loading").value = share;
}

function requireBrowser() {
  if (typeof WebGL2RenderingContext === "undefined" || !document.createElement("canvas").getContext("webgl2")) {
    throw new Error("This page needs WebGL 2, which this browser lacks or has switched off. Allow hardware acceleration "
      + "in its settings, or open the page in a current Chrome, Edge, Firefox or Safari.");
  }
  if (typeof DecompressionStream === "undefined") {
    throw new Error("This browser is too old for this page: it takes Chrome or Edge 80, Firefox 113, Safari 16.4, or "
      + "newer.");
  }
}

// What depends on the scene that is shown: a page whose scene changes calls it again.
function showModel(player) {
  const { model } = player;
  for (const part of document.querySelectorAll(".moving")) part.hidden = !model.nodes;
  for (const part of document.querySelectorAll(".filmed")) part.hidden = !model.facts.path;
  followFilm(player, player.follows);
  showTime(player);
}

// load(report): the scene's bytes. extend(player, clock): further abilities of the page; returns their keys.
async function startPage(load, extend = () => ({})) {
  requireBrowser();
  document.body.classList.toggle("bare", asked.has("noui"));
  const report = (share) => say(`Loading ${Math.round(100 * share)} %`, share);
  report(0);
  const raw = await load(report);
  say("Preparing the picture", 1);
  await nextTurn();
  const model = await readModel(raw);
  const player = new Player(element("view"), model), clock = new Clock(player);
  player.follows = Boolean(model.facts.path);
  player.seek(Number(asked.get("t") ?? 0) / player.seconds || 0);
  listenToPanel(player, clock);
  listenToPointers(player);
  listenToKeys(player, clock, extend(player, clock));
  setBackground(player, player.background);
  showModel(player);
  element("controls").hidden = false;
  hideWhenIdle(clock);
  const loop = (now) => {
    clock.tick(now);
    if (clock.playing) showTime(player);
    player.tick(now);
    requestAnimationFrame(loop);
  };
  requestAnimationFrame(loop);
  clock.play(!asked.has("paused") && !matchMedia("(prefers-reduced-motion: reduce)").matches);
  if (player.renderer) say("");
  const poster = element("poster");
  if (poster) {
    poster.classList.add("gone");
    setTimeout(() => poster.remove(), 500);
  }
  return { player, clock };
}

// For scripts and tests: an exact frame, for a camera as scgs_warp has them, as RGBA bytes, top row first.
function publish(ready) {
  ready.catch((error) => say(error.message));
  window.scgs = {
    ready,
    async renderAt(time, viewmat, K, width, height, background) {
      return (await ready).player.renderAt(time, viewmat, K, width, height, background);
    },
  };
}
