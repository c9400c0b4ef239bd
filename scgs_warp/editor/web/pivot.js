// The point about which the rings turn, when it was moved from the joint or the middle of the selection.

class Pivot {
  constructor(tools) {
    this.tools = tools;
    this.moved = null; // { of, node, local }: what it belongs to; a control point, in whose frame it lies
  }

  // What the rings turn.
  get turned() {
    return this.tools.state.selection.join();
  }

  // Put it on the surface under the pointer, where it stays on the nearest control point.
  put(event) {
    const { tools } = this, { player } = tools, point = tools.surface(event);
    if (!point) return;
    const node = tools.nearest(point), map = nodeMap(player.model.facts, player.shown, node);
    const away = [0, 1, 2].map((r) => point[r] - map[4 * r + 3]);
    const local = [0, 1, 2].map((c) => away.reduce((sum, value, r) => sum + map[4 * r + c] * value, 0));
    this.moved = { of: this.turned, node, local };
    player.stale = true;
  }

  // Where it is, in the units of the page; null: it was not moved.
  place() {
    const { moved, tools } = this, table = tools.player.shown;
    if (!moved || !table || moved.of !== this.turned) return null;
    return mapped(nodeMap(tools.player.model.facts, table, moved.node), moved.local);
  }

  reset() {
    this.moved = null;
    this.tools.player.stale = true;
  }
}
