// Control points, joints, ribbons and rings over the scene, drawn in the same frame with the surface's depth.

const DEPTH_SCALE = 2; // pixels of the canvas for one of the depth map
const FAINT = 0.22;
const VERTEX = 10; // numbers: pixel x y, depth, unused, rgba, corner

class Overlay {
  constructor(player) {
    this.player = player;
    this.items = () => {}; // adds what is to be drawn, by point() and line()
    this.numbers = new Float32Array(1 << 14);
    this.size = 0;
  }

  // The context may have been lost: everything is made for the present renderer.
  prepare() {
    const { renderer } = this.player, { gl } = renderer;
    if (this.renderer === renderer) return;
    this.renderer = renderer;
    this.map = null;
    this.program = compile(gl, SHADERS["overlay.vert"], SHADERS["overlay.frag"],
      { SHARPNESS: "0.0", DEPTH_SCALE, FAINT: FAINT.toFixed(2) });
    this.buffer = gl.createBuffer();
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    for (const [name, count, first] of [["a_place", 4, 0], ["a_color", 4, 4], ["a_corner", 2, 8]]) {
      const place = gl.getAttribLocation(this.program.program, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, count, gl.FLOAT, false, 4 * VERTEX, 4 * first);
    }
    gl.bindVertexArray(null);
  }

  depthMap(view) {
    const { renderer } = this, { gl } = renderer;
    const width = Math.ceil(view.width / DEPTH_SCALE), height = Math.ceil(view.height / DEPTH_SCALE);
    if (!this.map || this.map.width !== width || this.map.height !== height) {
      if (this.map) {
        gl.deleteTexture(this.map.texture);
        gl.deleteFramebuffer(this.map.target);
      }
      const texture = renderer.texture(renderer.precise ? gl.RGBA16F : gl.RGBA8, width, height);
      this.map = { width, height, texture, target: renderer.target(texture) };
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.map.target);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!renderer.precise) return this.map.texture; // depths do not fit into bytes: nothing is hidden
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    renderer.use(renderer.depth, renderer.splats);
    gl.uniform2f(renderer.depth.place("u_size"), view.width, view.height);
    gl.bindVertexArray(renderer.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * renderer.amount);
    return this.map.texture;
  }

  draw(view) {
    this.view = view;
    this.size = 0;
    this.items(this);
    if (!this.size || !this.player.renderer) return;
    this.prepare();
    const { renderer, program } = this, { gl } = renderer, depth = this.depthMap(view);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, view.width, view.height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    renderer.use(program, { u_depth: depth });
    gl.uniform2f(program.place("u_size"), view.width, view.height);
    gl.uniform1f(program.place("u_behind"), this.behind ?? 0);
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, this.numbers.subarray(0, this.size), gl.STREAM_DRAW);
    gl.drawArrays(gl.TRIANGLES, 0, this.size / VERTEX);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }

  // [pixel x, pixel y, depth] of a point, or null behind the camera.
  project(point) {
    const { rows, shift, lens } = this.view, [x, y, z] = rows.map((row, r) => dot(row, point) + shift[r]);
    return z > 0.01 ? [(lens[0] * x) / z + lens[2], (lens[1] * y) / z + lens[3], z] : null;
  }

  quad(corners, depth, color) {
    if (this.size + 6 * VERTEX > this.numbers.length) {
      const larger = new Float32Array(2 * this.numbers.length);
      larger.set(this.numbers);
      this.numbers = larger;
    }
    for (const k of [0, 1, 2, 2, 1, 3]) {
      const [x, y, u, v] = corners[k];
      this.numbers.set([x, y, depth, 0, ...color, u, v], this.size);
      this.size += VERTEX;
    }
  }

  // Sizes in CSS pixels; front: never hidden.
  point(place, size, color, front = false) {
    const seen = this.project(place);
    if (!seen) return;
    const r = size * this.scale, [x, y, z] = seen;
    this.quad([[x - r, y - r, -1, -1], [x + r, y - r, 1, -1], [x - r, y + r, -1, 1], [x + r, y + r, 1, 1]],
      front ? 0 : z, color);
  }

  line(from, to, width, color, front = false) {
    const a = this.project(from), b = this.project(to);
    if (!a || !b) return;
    const dx = b[0] - a[0], dy = b[1] - a[1], length = Math.hypot(dx, dy) || 1, half = 0.5 * width * this.scale + 0.5;
    const [nx, ny] = [(-dy / length) * half, (dx / length) * half];
    this.quad([[a[0] + nx, a[1] + ny, 0, 1], [b[0] + nx, b[1] + ny, 0, 1], [a[0] - nx, a[1] - ny, 0, -1],
      [b[0] - nx, b[1] - ny, 0, -1]], front ? 0 : 0.5 * (a[2] + b[2]), color);
  }

  get scale() {
    return this.view.width / Math.max(1, this.player.canvas.clientWidth);
  }
}
