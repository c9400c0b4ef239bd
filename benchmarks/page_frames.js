// What page_frames.py asks of a page; the browser runs it before the page's own program.
"use strict";

window.said = []; // what the page has said while it loads
window.measured = {
  idle: () => {
    const { stale, unsorted, sorting, moving } = window.player;
    return !stale && !unsorted && !sorting && !moving;
  },

  turn: () => {
    window.player.orbit.azimuth += 0.2;
    window.player.changed();
  },

  // Waits until everything that was asked for is drawn.
  finish: () => {
    const { gl, renderer } = window.player;
    gl.bindFramebuffer(gl.FRAMEBUFFER, renderer.sum.target);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, new Float32Array(4));
  },

  // The share of the pixels that are not black.
  shareDrawn: () => {
    const { player } = window, { gl, canvas } = player;
    player.stale = true;
    player.frame();
    const bytes = new Uint8Array(4 * canvas.width * canvas.height);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    let bright = 0;
    for (let i = 0; i < bytes.length; i += 4) bright += bytes[i] + bytes[i + 1] + bytes[i + 2] > 60 ? 1 : 0;
    return bright / (canvas.width * canvas.height);
  },
};

(function look() {
  const text = document.getElementById("said")?.textContent;
  if (text && text !== window.said.at(-1)) window.said.push(text);
  if (window.scgs && !window.made) {
    window.made = true;
    window.scgs.ready.then((ready) => { window.player = ready.player; });
  }
  setTimeout(look, 20);
})();
