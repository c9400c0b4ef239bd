// Control points chosen by an area of the picture: a lasso, or a brush that is drawn over the surface.

// Where the control points are seen, in CSS pixels of the canvas; null behind the camera.
function seenPoints(player) {
  const { places, canvas } = player, view = player.view(), share = canvas.clientWidth / canvas.width, seen = [];
  for (let m = 0; m < places.length / 3; m++) {
    const point = [places[3 * m], places[3 * m + 1], places[3 * m + 2]];
    const [x, y, z] = view.rows.map((row, r) => dot(row, point) + view.shift[r]);
    seen.push(z > 0 ? [((view.lens[0] * x) / z + view.lens[2]) * share, ((view.lens[1] * y) / z + view.lens[3]) * share] : null);
  }
  return seen;
}

const clearLasso = () => document.querySelector("#lasso polygon").setAttribute("points", "");

class Lasso {
  constructor(tools, event) {
    this.tools = tools;
    this.way = [tools.spot(event)];
    this.nodes = [];
    this.seen = seenPoints(tools.player);
  }

  // Points that are chosen if it ends here.
  chosen(selection, how) {
    const inside = new Set(this.nodes);
    return new Set(how === "add" ? [...selection, ...this.nodes] : selection.filter((m) => !inside.has(m)));
  }

  move(event) {
    this.way.push(this.tools.spot(event));
    document.querySelector("#lasso polygon").setAttribute("points", this.way.map((point) => point.join(",")).join(" "));
    this.nodes = [...this.seen.keys()].filter((m) => this.seen[m] && this.holds(...this.seen[m]));
    this.tools.player.stale = true;
  }

  holds(x, y) {
    return this.way.reduce((odd, [ax, ay], k) => {
      const [bx, by] = this.way[(k + 1) % this.way.length];
      return (ay > y) !== (by > y) && x < ((bx - ax) * (y - ay)) / (by - ay) + ax ? !odd : odd;
    }, false);
  }

  take() {
    return this.nodes;
  }
}

class Brush extends Lasso {
  constructor(tools, event) {
    super(tools, event);
    this.latest = event;
    this.tick();
  }

  move(event) {
    this.latest = event;
  }

  // Once a frame: the surface under the pointer has to be read.
  tick() {
    const { tools, latest } = this, point = latest && tools.surface(latest);
    this.latest = null;
    if (!point) return;
    const { places } = tools.player, radius = brushRadius(tools);
    for (let m = 0; m < places.length / 3; m++) {
      const near = Math.hypot(...point.map((value, k) => value - places[3 * m + k])) <= radius;
      if (near && !this.nodes.includes(m)) this.nodes.push(m);
    }
    showBrush(tools, point);
    tools.player.stale = true;
  }

  take(event) {
    this.latest = event;
    this.tick();
    return this.nodes;
  }
}

// In the units of the page.
const brushRadius = (tools) => tools.state.tool.radius * tools.player.model.facts.normalisation.scale;

// The circle of the brush where the pointer is; without a point, none.
function showBrush(tools, point) {
  const circle = element("brush");
  if (!point) return circle.setAttribute("r", 0);
  const { canvas } = tools.player, view = tools.player.view(), share = canvas.clientWidth / canvas.width;
  const [x, y, z] = view.rows.map((row, r) => dot(row, point) + view.shift[r]);
  circle.setAttribute("cx", ((view.lens[0] * x) / z + view.lens[2]) * share);
  circle.setAttribute("cy", ((view.lens[1] * y) / z + view.lens[3]) * share);
  circle.setAttribute("r", (view.lens[0] / z) * brushRadius(tools) * share);
}

// The part of the picture that the film shows, while the view is its camera's.
function showFilmed(player) {
  const { clientWidth, clientHeight } = player.canvas, frame = element("filmed"), { aspect } = player.model.facts.overview;
  const width = player.follows ? Math.min(clientWidth, clientHeight * aspect) : 0;
  const key = `${width} ${clientWidth} ${clientHeight}`;
  if (frame.dataset.key === key) return;
  frame.dataset.key = key;
  for (const [name, value] of [["x", (clientWidth - width) / 2], ["y", (clientHeight - width / aspect) / 2],
    ["width", width], ["height", width / aspect]]) frame.setAttribute(name, value);
}
