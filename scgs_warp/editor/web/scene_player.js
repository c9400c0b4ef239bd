// The scene as the edit poses it, drawn by the player of exported pages.

class StudioPlayer extends Player {
  // Take the film's camera: its path over the film, and its lens and upright axis.
  film({ path, overview }) {
    this.model.facts.path = path;
    this.filmed = overview;
    this.free = { ...this.model.facts.overview, up: overview.up };
    this.changed();
  }

  view() {
    this.orbit.overview = this.follows ? this.filmed : this.free ?? this.model.facts.overview;
    return super.view();
  }

  // The second of the film that is shown.
  get at() {
    return this.time * this.seconds;
  }

  get seconds() {
    return this.link?.state?.film.seconds ?? SECONDS;
  }

  get fps() {
    return this.link?.state?.film.fps ?? 30;
  }

  pose(time, table, exact) {
    const { link, model } = this, state = link?.state;
    if (!state || state.unedited || this.original) poseAt(model, state ? sceneTime(state, time * this.seconds) : time, table);
    else if (state.dragging && link.live) table.set(link.live);
    else {
      const frames = Math.max(1, Math.round(this.seconds * this.fps));
      const frame = Math.min(Math.floor(time * this.seconds * this.fps + 1e-6), frames - 1);
      const pose = link.poseOf(frame, frames, this.clock?.playing);
      if (pose) table.set(pose);
      else if (this.shown) table.set(this.shown);
      else poseAt(model, sceneTime(state, time * this.seconds), table);
    }
    if (!exact) this.observe(table);
    return table;
  }

  // Keep where the control points are, and light up what the pointer is on.
  observe(table) {
    const { nodes, trajectories } = this.model, { rest } = trajectories;
    this.places ??= new Float64Array(3 * nodes);
    this.shown = table.slice();
    for (let m = 0; m < nodes; m++) {
      const row = 28 * m;
      for (let r = 0; r < 3; r++) {
        const at = row + 4 * r;
        this.places[3 * m + r] = table[at] * rest[3 * m] + table[at + 1] * rest[3 * m + 1] + table[at + 2] * rest[3 * m + 2]
          + table[at + 3];
      }
      table[row + 19] = this.tools?.lights(m) ? 1 : 0;
    }
  }
}
