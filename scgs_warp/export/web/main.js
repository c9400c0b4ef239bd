// Start, or say in words why not.

function say(text) {
  element("message").textContent = text;
  element("message").hidden = !text;
}

async function start() {
  if (typeof WebGL2RenderingContext === "undefined" || !document.createElement("canvas").getContext("webgl2")) {
    throw new Error("This page needs WebGL 2, which this browser lacks or has switched off. Allow hardware acceleration "
      + "in its settings, or open the page in a current Chrome, Edge, Firefox or Safari.");
  }
  if (typeof DecompressionStream === "undefined") {
    throw new Error("This browser is too old for this page: it takes Chrome or Edge 80, Firefox 113, Safari 16.4, or "
      + "newer.");
  }
  say("Loading\u2026");
  const model = await readModel(element("data").textContent);
  element("data").remove(); // it is decoded, and long
  const player = new Player(element("view"), model), clock = new Clock(player);
  listenToPanel(player, clock);
  listenToPointers(player);
  listenToKeys(player, clock);
  setBackground(player, player.background);
  for (const still of [element("play"), element("time"), element("clock"), ...document.querySelectorAll(".moving")]) {
    still.hidden = !model.nodes;
  }
  element("controls").hidden = false;
  const loop = (now) => {
    clock.tick(now);
    if (clock.playing) showTime(player);
    player.tick(now);
    requestAnimationFrame(loop);
  };
  requestAnimationFrame(loop);
  clock.play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  say("");
  return { player, clock };
}

const ready = start();
ready.catch((error) => say(error.message));

// For scripts and tests: an exact frame, for a camera as scgs_warp has them, as RGBA bytes, top row first.
window.scgs = {
  ready,
  async renderAt(time, viewmat, K, width, height, background) {
    return (await ready).player.renderAt(time, viewmat, K, width, height, background);
  },
};
