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
    const { nodes, facts } = this.model, width = nodeWidth(facts);
    this.shown = table.slice();
    this.places = this.placesIn(table, this.places);
    for (let m = 0; m < nodes; m++) table[width * m + 19] = this.tools?.lights(m) ? 1 : 0;
  }

  // Where a table of poses has the control points, the units of the page.
  placesIn(table, places = new Float64Array(3 * this.model.nodes)) {
    const { nodes, facts, trajectories: { rest } } = this.model;
    for (let m = 0; m < nodes; m++) {
      places.set(mapped(nodeMap(facts, table, m), rest.subarray(3 * m, 3 * m + 3)), 3 * m);
    }
    return places;
  }
}
