const LIGHT = [0.45, 0.8, 1]; // of what the pointer is on

// Three passes: one fragment a Gaussian (splat), their quads (draw), the background (screen).

function compile(gl, vertex, fragment, defines) {
  const head = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n"
    + "precision highp usampler2D;\n"
    + Object.entries({ WIDTH, ...defines }).map(([name, value]) => `#define ${name} ${value}\n`).join("")
    + SHADERS["shared"];
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, head + text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader); // with the program
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
      throw new Error("shader: " + gl.getShaderInfoLog(shader));
    }
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error("program: " + gl.getProgramInfoLog(program));
  }
  const places = {};
  return { program, place: (name) => (places[name] ??= gl.getUniformLocation(program, name)) };
}

class Renderer {
  constructor(gl, model) {
    this.gl = gl;
    this.model = model;
    if (model.means.length / (4 * WIDTH) * 4 > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error(`${model.count} Gaussians are more than this graphics driver has room for`);
    }
    const SHARPNESS = (model.facts.sharpness ?? 0).toFixed(6);
    const { facts } = model, texels = Math.ceil(((facts.sh_degree + 1) ** 2 - 1) / 4);
    const defines = {
      NODES: model.nodes, BLOCKS: model.stride / 4, DEGREE: facts.sh_degree, SH_TEXELS: texels,
      COLOR_TEXELS: facts.shaded ? 4 : 1, SHARPNESS, NODE_TEXELS: nodeWidth(facts) / 4,
    };
    for (const name of ["shaded", "tinted", "corrected", "masked", "antialiased", "edited"]) {
      if (facts[name]) defines[name.toUpperCase()] = 1;
    }
    this.splat = compile(gl, SHADERS["screen.vert"], SHADERS["splat.frag"], defines);
    this.draw = compile(gl, SHADERS["draw.vert"], SHADERS["draw.frag"], { SHARPNESS });
    this.depth = compile(gl, SHADERS["draw.vert"], SHADERS["draw.frag"], { SHARPNESS, DEPTH: 1 });
    this.screen = compile(gl, SHADERS["screen.vert"], SHADERS["screen.frag"], { SHARPNESS });
    // Halves, where they can be drawn to: sums of many faint Gaussians lose what 8 bits round away.
    const precise = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.precise = Boolean(precise);
    this.sumFormat = precise ? gl.RGBA16F : gl.RGBA8;
    this.owned = []; // textures and framebuffers
    this.makeData();
    this.makeOrder();
  }

  dispose() {
    const { gl } = this;
    for (const { program } of [this.splat, this.draw, this.depth, this.screen]) gl.deleteProgram(program);
    for (const thing of this.owned) {
      if (thing instanceof WebGLTexture) gl.deleteTexture(thing);
      else gl.deleteFramebuffer(thing);
    }
    gl.deleteVertexArray(this.nothing);
    if (this.probe) {
      gl.deleteTexture(this.probe.texture);
      gl.deleteFramebuffer(this.probe.target);
    }
    this.dropSum();
  }

  dropSum() {
    const { gl, sum } = this;
    if (!sum) return;
    gl.deleteTexture(sum.texture);
    gl.deleteFramebuffer(sum.target);
    this.sum = null;
  }

  texture(format, width, height) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
  }

  upload(format, layout, type, data) {
    const { gl } = this, height = data.length / (4 * WIDTH), texture = this.texture(format, WIDTH, height);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, height, layout, type, data);
    this.owned.push(texture);
    return texture;
  }

  target(...textures) {
    const { gl } = this, framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const slots = textures.map((texture, k) => {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0);
      return gl.COLOR_ATTACHMENT0 + k;
    });
    gl.drawBuffers(slots);
    return framebuffer;
  }

  makeData() {
    const { gl, model } = this;
    const floats = (data) => this.upload(gl.RGBA32F, gl.RGBA, gl.FLOAT, data);
    this.data = {
      u_means: floats(model.means),
      u_quats: floats(model.quats),
      u_scales: floats(model.scales),
      u_colors: this.upload(gl.RGBA16F, gl.RGBA, gl.FLOAT, model.colors),
      u_weights: floats(model.weights),
      u_harmonics: this.upload(gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, model.harmonics),
      u_indices: this.upload(gl.RGBA16UI, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT, model.indices),
    };
    if (model.correctives) this.data.u_correctives = this.upload(gl.RGBA16F, gl.RGBA, gl.FLOAT, model.correctives);
    this.table = room(Float32Array, Math.max(model.nodes, 1), nodeWidth(model.facts));
    this.data.u_nodes = floats(this.table);
    this.rows = Math.ceil(model.count / WIDTH);
    this.splats = { u_place: this.texture(gl.RGBA32UI, WIDTH, this.rows),
      u_color: this.texture(gl.RGBA32UI, WIDTH, this.rows) };
    this.splatTarget = this.target(this.splats.u_place, this.splats.u_color);
    this.owned.push(this.splats.u_place, this.splats.u_color, this.splatTarget);
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && !gl.isContextLost()) {
      throw new Error("this graphics driver cannot draw to integer textures");
    }
  }

  makeOrder() {
    const { gl } = this;
    this.nothing = gl.createVertexArray();
    this.splats.u_order = this.texture(gl.R32UI, WIDTH, this.rows);
    this.owned.push(this.splats.u_order);
    this.padded = new Uint32Array(WIDTH * this.rows);
    this.amount = 0;
  }

  setOrder(order, amount) {
    const { gl, padded } = this, rows = Math.ceil(amount / WIDTH);
    this.amount = amount;
    padded.set(order.subarray(0, amount));
    gl.bindTexture(gl.TEXTURE_2D, this.splats.u_order);
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, padded);
  }

  // The sum, one size at a time.
  sized(width, height) {
    const { gl } = this;
    if (this.sum && this.sum.width === width && this.sum.height === height) return this.sum;
    this.dropSum();
    const texture = this.texture(this.sumFormat, width, height);
    this.sum = { width, height, texture, target: this.target(texture) };
    return this.sum;
  }

  use({ program, place }, textures) {
    const { gl } = this;
    gl.useProgram(program);
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(place(name), unit);
    });
    gl.activeTexture(gl.TEXTURE0);
  }

  // Nothing is done if only the order of the Gaussians is another than in the previous frame.
  project(view, table) {
    const { gl, model, splat } = this;
    const seen = [view.rows, view.shift, view.eye, view.lens, view.width, view.height].flat(2).join();
    if (seen === this.seen && table.every((value, k) => value === this.table[k])) return;
    this.seen = seen;
    this.table.set(table);
    gl.bindTexture(gl.TEXTURE_2D, this.data.u_nodes);
    const height = this.table.length / (4 * WIDTH);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, height, gl.RGBA, gl.FLOAT, this.table);
    this.use(splat, this.data);
    gl.uniform3fv(splat.place("u_sh_low"), model.shLow);
    gl.uniform3fv(splat.place("u_sh_step"), model.shStep);
    gl.uniform1i(splat.place("u_count"), model.count);
    gl.uniform3fv(splat.place("u_view"), view.rows.flat());
    gl.uniform3fv(splat.place("u_shift"), view.shift);
    gl.uniform3fv(splat.place("u_eye"), view.eye);
    gl.uniform4fv(splat.place("u_lens"), view.lens);
    gl.uniform2f(splat.place("u_size"), view.width, view.height);
    gl.uniform3fv(splat.place("u_light"), LIGHT);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.splatTarget);
    gl.viewport(0, 0, WIDTH, this.rows);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // view: of normalised(); table: of poseAt(); the order is that of the last setOrder. target null: the canvas.
  render(view, table, background, target) {
    const { gl } = this, { width, height } = view;
    this.project(view, table);
    const sum = this.sized(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, sum.target);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.use(this.draw, this.splats);
    gl.uniform2f(this.draw.place("u_size"), width, height);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * this.amount);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.disable(gl.BLEND);
    this.use(this.screen, { u_image: sum.texture });
    gl.uniform3fv(this.screen.place("u_background"), background);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The point of the surface at a pixel of the picture that was drawn last, in the units of the page; null: background.
  surface(view, x, y) {
    const { gl } = this, { width, height } = view;
    if (!this.precise || x < 0 || y < 0 || x >= width || y >= height) return null;
    this.probe ??= { texture: this.texture(gl.RGBA16F, 1, 1) };
    this.probe.target ??= this.target(this.probe.texture);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.probe.target);
    gl.viewport(-Math.floor(x), -Math.floor(height - y - 1e-6), width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.use(this.depth, this.splats);
    gl.uniform2f(this.depth.place("u_size"), width, height);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * this.amount);
    gl.disable(gl.BLEND);
    const found = new Float32Array(4);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, found);
    const [sum, , , alpha] = found;
    if (!(alpha >= 0.5)) return null;
    const depth = sum / alpha, [fx, fy, cx, cy] = view.lens;
    const seen = [((x - cx) / fx) * depth, ((y - cy) / fy) * depth, depth].map((v, k) => v - view.shift[k]);
    return [0, 1, 2].map((c) => view.rows.reduce((total, row, r) => total + row[c] * seen[r], 0));
  }

  // As render, into memory: RGBA bytes, top row first.
  read(view, table, background) {
    const { gl } = this, { width, height } = view;
    const texture = this.texture(gl.RGBA8, width, height), target = this.target(texture);
    this.render(view, table, background, target);
    const bytes = new Uint8Array(4 * width * height), row = 4 * width;
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    gl.deleteTexture(texture);
    gl.deleteFramebuffer(target);
    const pixels = new Uint8ClampedArray(bytes.length);
    for (let y = 0; y < height; y++) pixels.set(bytes.subarray(row * (height - 1 - y), row * (height - y)), row * y);
    return pixels;
  }
}
