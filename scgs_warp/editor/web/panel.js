// Settings beside the picture, made of small descriptions: what a control is called, what it shows, what it asks for.

// A control: { label, type, get(state), set(value), ... }; `when(state)`: whether it can act.
class Panel {
  constructor(place, sections) {
    this.place = place;
    this.controls = [];
    for (const { title, open, rows } of sections) {
      const box = document.createElement("details"), head = document.createElement("summary");
      const inside = document.createElement("div");
      box.open = Boolean(open);
      head.textContent = title;
      inside.className = "rows";
      inside.append(...rows.map((row) => this.make(row)));
      box.append(head, inside);
      place.append(box);
    }
  }

  // What is being typed into a field stays when the state changes; afterwards the field shows the state again.
  watch(input) {
    for (const [event, typed] of [["input", true], ["change", false], ["blur", false]]) {
      input.addEventListener(event, () => { input.typed = typed; });
    }
    input.addEventListener("blur", () => this.show(this.state));
  }

  make(row) {
    if (row.type === "buttons") {
      const line = document.createElement("div");
      line.className = "row";
      line.append(...row.items.map((item) => this.button(item)));
      return line;
    }
    if (row.type === "text") {
      const line = document.createElement("p");
      this.controls.push((state) => { line.textContent = row.get(state); });
      return line;
    }
    return row.type === "triple" ? this.triple(row) : this.field(row);
  }

  button({ label, title, press, when }) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = label;
    if (title) button.title = title;
    button.addEventListener("click", press);
    this.controls.push((state) => { button.disabled = Boolean(when && !when(state)); });
    return button;
  }

  field(row) {
    const label = document.createElement("label"), text = document.createElement("span");
    text.textContent = row.label;
    const input = document.createElement(row.type === "choice" ? "select" : "input");
    if (row.title) label.title = row.title;
    if (row.type !== "choice") input.type = row.type;
    input.setAttribute("aria-label", row.label);
    for (const name of ["min", "max", "step", "maxlength"]) if (row[name] !== undefined) input.setAttribute(name, row[name]);
    const fillOptions = (options) => {
      const key = JSON.stringify(options);
      if (input.dataset.options === key) return;
      input.dataset.options = key;
      input.replaceChildren(...options.map(([value, said]) => new Option(said, value)));
    };
    if (row.type === "choice" && Array.isArray(row.options)) fillOptions(row.options);
    if (/^(number|color)$/.test(row.type)) this.watch(input);
    input.addEventListener("change", () => {
      const value = row.type === "checkbox" ? input.checked : row.type === "number" ? Number(input.value) : input.value;
      if (row.type === "number" && (input.value === "" || !input.checkValidity())) return input.reportValidity();
      row.set(value);
    });
    this.controls.push((state) => {
      if (typeof row.options === "function") fillOptions(row.options(state));
      input.disabled = Boolean(row.when && !row.when(state));
      if (input.typed) return;
      const value = row.get(state);
      if (row.type === "checkbox") input.checked = Boolean(value);
      else if (input.value !== String(value)) input.value = row.type === "number" ? tidy(value) : value;
    });
    label.append(text, input);
    return row.picture ? this.explained(label, row) : label;
  }

  // A control with a button that explains it by a picture.
  explained(label, row) {
    const line = document.createElement("div"), button = document.createElement("button");
    line.className = "helped";
    button.type = "button";
    button.textContent = "?";
    button.setAttribute("aria-label", `About: ${row.label}`);
    button.addEventListener("click", () => {
      element("helped").textContent = row.label;
      element("explained").textContent = row.title;
      document.querySelector("#help use").setAttribute("href", `#picture-${row.picture}`);
      element("help").showModal();
    });
    line.append(label, button);
    return line;
  }

  // Three numbers of one thing.
  triple(row) {
    const line = document.createElement("label"), text = document.createElement("span");
    const fields = document.createElement("span");
    let exact = [0, 0, 0]; // what is not typed stays as it is, although it is shown rounded
    text.textContent = row.label;
    fields.className = "triple";
    const inputs = ["x", "y", "z"].map((axis) => {
      const input = document.createElement("input");
      input.type = "number";
      input.step = "any";
      input.setAttribute("aria-label", `${row.label}, ${axis}`);
      this.watch(input);
      input.addEventListener("change", () => {
        if (input.value === "" || !input.checkValidity()) return;
        row.set(exact.map((value, k) => (inputs[k] === input ? Number(input.value) : value)));
      });
      return input;
    });
    this.controls.push((state) => {
      exact = row.get(state);
      inputs.forEach((input, k) => {
        input.disabled = Boolean(row.when && !row.when(state));
        input.title = tidy(exact[k]);
        if (!input.typed) input.value = Math.abs(exact[k]) < 1e-6 ? 0 : Number(Number(exact[k]).toPrecision(3));
      });
    });
    fields.append(...inputs);
    line.append(text, fields);
    return line;
  }

  show(state) {
    this.state = state;
    for (const control of this.controls) control(state);
  }
}

const tidy = (value) => String(Number(Number(value).toFixed(4)));

function panelSections(studio) {
  const { link, player, tools } = studio, at = () => player.at;
  const ask = (what, fields = {}) => link.ask(what, { at: at(), ...fields });
  const chosen = (state) => state.selection.length > 0, active = (state) => Boolean(state.active);
  const partNames = () => [["", "none"], ...tools.parts.map(({ name }) => [name, name])];
  return [
    { title: "Part or handle", open: true, rows: [
      { type: "choice", label: "Part", options: partNames, get: (s) => s.part ?? "",
        set: (name) => (name ? ask("choose_part", { name }) : ask("pick", { how: "replace" })) },
      { type: "choice", label: "Handle", options: (s) => [["", "none"], ...s.handles.map(({ name, part }) =>
        [name, part ? `${isolated(part)} (part)` : name])], get: (s) => s.active ?? "", set: (name) => name && ask("activate", { name }) },
      { type: "buttons", items: [
        { label: "Rename", when: (s) => s.part || s.active, press: () => studio.changes.rename() },
        { label: "Merge", title: "Make the part and a neighbour one", when: (s) => s.part && studio.changes.neighbours(s.part).length,
          press: () => studio.changes.merge() },
        { label: "Attach", title: "Make the part hang on another one", when: (s) => s.part && studio.changes.supports(s.part).length,
          press: () => studio.changes.attach() },
        { label: "Split", title: "Make the chosen control points of a part a part of their own", when: (s) => !s.part && chosen(s),
          press: () => studio.changes.split() }] },
      { type: "triple", label: "Move", when: (s) => active(s) || chosen(s), get: (s) => s.target.translation,
        set: (translation) => ask("put", { translation }) },
      { type: "triple", label: "Turn, degrees", when: (s) => active(s) || chosen(s), get: (s) => s.target.degrees,
        set: (degrees) => ask("put", { degrees }) },
      { type: "choice", label: "It lasts", options: [["motion", "the whole motion"], ["frame", "one frame"], ["fade", "and fades"]],
        title: "How long a handle acts: always, in the frame at which it was moved, or fading out around it", picture: "lasts",
        get: (s) => (s.handles.find((h) => h.name === s.active) ?? s.tool).lasts, set: (lasts) => ask("handle", { lasts }) },
      { type: "number", label: "Fades over, of the motion", min: 0.001, max: 10, step: 0.01,
        when: (s) => (s.handles.find((h) => h.name === s.active) ?? s.tool).lasts === "fade",
        get: (s) => (s.handles.find((h) => h.name === s.active) ?? s.tool).window, set: (window) => ask("handle", { window }) },
      { type: "number", label: "Stiffness, 0 is exact", min: 0, max: 1e6, step: 0.01,
        get: (s) => (s.handles.find((h) => h.name === s.active) ?? s.tool).stiffness ?? 0,
        set: (stiffness) => ask("handle", { stiffness }) },
      { type: "buttons", items: [
        { label: "Put back", when: active, press: () => ask("put", { translation: [0, 0, 0], degrees: [0, 0, 0] }) },
        { label: "Remove", when: active, press: () => ask("remove") }] },
    ] },
    { title: "Control points", rows: [
      { type: "text", get: (s) => `${s.selection.length} chosen, ${s.pins.length} pinned` },
      { type: "choice", label: "A click takes", options: [["rings", "rings"], ["brush", "what a brush covers"]],
        title: "Rings: the nearest control point and its neighbours, theirs, and so on", picture: "rings", get: (s) => s.tool.region,
        set: (region) => ask("tool", { region }) },
      { type: "choice", label: "A drag", options: [["moves", "moves them, or the view"], ["chooses", "chooses: lasso, brush"]],
        title: "With Shift, a drag always chooses", when: () => tools.kind === "points",
        get: () => (tools.areas ? "chooses" : "moves"), set: (does) => { tools.areas = does === "chooses"; } },
      { type: "number", label: "Rings", min: 0, max: 12, step: 1, when: (s) => s.tool.region === "rings",
        get: (s) => s.tool.rings, set: (rings) => ask("tool", { rings }) },
      { type: "number", label: "Brush, scene units", min: 0, step: "any", when: (s) => s.tool.region === "brush",
        get: (s) => s.tool.radius, set: (radius) => ask("tool", { radius }) },
      { type: "choice", label: "and it is", options: [["replace", "the selection"], ["add", "added"], ["subtract", "removed"]],
        get: (s) => s.tool.combine, set: (combine) => ask("tool", { combine }) },
      { type: "buttons", items: [
        { label: "All", press: () => ask("select", { what: "all" }) },
        { label: "None", when: chosen, press: () => ask("select", { what: "none" }) },
        { label: "Grow", when: chosen, press: () => ask("select", { what: "grow" }) },
        { label: "Invert", press: () => ask("select", { what: "invert" }) }] },
      { type: "checkbox", label: "New handles pin the rest", get: (s) => s.tool.pin_rings !== null,
        title: "Control points far from a new handle stay where the motion has them",
        set: (on) => ask("tool", { pin_rings: on ? 3 : null }) },
      { type: "number", label: "beyond rings", min: 0, max: 20, step: 1, when: (s) => s.tool.pin_rings !== null,
        get: (s) => s.tool.pin_rings ?? 3, set: (rings) => ask("tool", { pin_rings: rings }) },
      { type: "buttons", items: [
        { label: "Pin", when: chosen, press: () => ask("pin", { what: "selection" }) },
        { label: "Unpin", when: chosen, press: () => ask("pin", { what: "selection", off: true }) },
        { label: "Pin rest", when: (s) => s.handles.length > 0, press: () => ask("pin", { what: "rest" }) },
        { label: "Unpin all", when: (s) => s.pins.length > 0, press: () => ask("pin", { what: "none" }) }] },
    ] },
    { title: "Motion", rows: [
      { type: "choice", label: "Hold stays on", options: [["body", "its body"], ["world", "its place"]],
        title: "A held region keeps its pose while the rest moves: carried by the body, or fixed in place", picture: "holds",
        get: () => studio.holdFrame, set: (frame) => { studio.holdFrame = frame; } },
      { type: "buttons", items: [
        { label: "Hold as it is now", when: chosen, press: () => ask("hold", { frame: studio.holdFrame }) },
        { label: "Let go of the last", when: (s) => s.holds.length > 0,
          press: () => ask("unhold", { index: link.state.holds.length - 1 }) }] },
      { type: "text", get: (s) => (s.holds.length ? s.holds.map((h) => `${h.count} control points as at ${h.time.toFixed(2)}, on ${
        h.frame === "body" ? "their body" : "their place"}`).join("; ") : "Nothing is held.") },
      { type: "number", label: "Motion times", min: 0, max: 10, step: 0.05, title: "Scales every turn; 1 changes nothing",
        get: (s) => s.exaggerate?.factor ?? 1, set: (factor) => ask("exaggerate", { factor }) },
      { type: "buttons", items: [
        { label: "Selection only", when: chosen, press: () => ask("exaggerate", { selection: true }) },
        { label: "About this pose", press: () => ask("exaggerate", { here: true }) },
        { label: "Off", when: (s) => s.exaggerate !== null, press: () => ask("exaggerate", { off: true }) }] },
    ] },
    { title: "Film", rows: [
      { type: "number", label: "Length, seconds", min: 0.04, max: 600, step: "any", get: (s) => s.film.seconds,
        set: (seconds) => ask("film", { seconds }) },
      { type: "number", label: "Frames a second", min: 1, max: 120, step: "any", get: (s) => s.film.fps,
        set: (fps) => ask("film", { fps }) },
      { type: "number", label: "Longer side, pixels", min: 16, max: 8192, step: 1, get: (s) => s.film.size,
        set: (size) => ask("film", { size }) },
      { type: "choice", label: "The motion plays", options: [["once", "once"], ["loop", "again and again"],
        ["swing", "back and forth"], ["still", "not: this moment"]],
        get: (s) => (s.playback.freeze === null ? s.playback.repeat : "still"), set: (repeat) => ask("playback", { repeat }) },
      { type: "number", label: "Its speed", min: -100, max: 100, step: 0.1, get: (s) => s.playback.speed,
        set: (speed) => ask("playback", { speed }) },
      { type: "text", get: (s) => `Camera: ${{ turntable: "once round the scene", fixed: "a fixed view",
        orbit: "a path through views" }[s.film.shot]}` },
      { type: "buttons", items: [
        { label: "Round", press: () => ask("shot", { kind: "turntable" }) },
        { label: "From here", press: () => ask("shot", { kind: "fixed", ...studio.view() }) },
        { label: "Add this view", press: () => ask("shot", { kind: "orbit", ...studio.view() }) }] },
    ] },
    { title: "View", rows: [
      ...[["points", "Control points"], ["graph", "Graph between them"], ["bones", "Joints of the chosen part"],
        ["ribbons", "Trained trajectories"]].map(([name, label]) => ({ type: "checkbox", label, get: () => tools.show[name],
        set: (on) => studio.display(name, on) })),
      { type: "checkbox", label: "Rings along the part", title: "Axes of the turning rings: the part's instead of the world's",
        get: () => tools.local, set: (on) => { tools.local = on; player.changed(); } },
      { type: "choice", label: "Upright axis", title: "What is up in the view and in the film",
        options: (s) => [["scene", "the scene's"], ...["x", "y", "z", "-x", "-y", "-z"].map((axis) => [axis, axis]),
          ...(s.film.up === "other" ? [["other", "another"]] : [])], get: (s) => s.film.up, set: (up) => ask("film", { up }) },
      { type: "color", label: "Background", get: () => hex(player.background), set: (value) => studio.paint(numbers(value)) },
      { type: "choice", label: "Colours of the page", options: [["dark", "dark"], ["light", "light"]],
        get: () => (document.body.classList.contains("light") ? "light" : "dark"), set: (theme) => studio.theme(theme) },
    ] },
    { title: "Files", rows: [
      { type: "text", get: () => `In ${studio.folder}` },
      { type: "text", get: (s) => (s.problem ? `Not saved: ${s.problem}` : "The edit is kept after every change.") },
      { type: "text", get: (s) => (s.job ? `${s.job.name}: ${s.job.stopping ? "stopping" : `${Math.round(s.job.percent)} %`}` : "") },
      { type: "buttons", items: [
        { label: "Save a copy", press: () => studio.save() },
        { label: "Load a file", press: () => studio.choose() },
        { label: "Stop the export", when: (s) => s.job !== null, press: () => ask("stop_job") }] },
      { type: "choice", label: "Saved edits", options: () => [["", "choose"], ...studio.files.map((name) => [name, name])],
        get: () => "", set: (name) => name && ask("load", { name }) },
      { type: "buttons", items: [
        { label: "Film, mp4", press: () => ask("export_film", { name: studio.name, format: ".mp4" }) },
        { label: "Film, gif", press: () => ask("export_film", { name: studio.name, format: ".gif" }) },
        { label: "Gaussians, ply", press: () => ask("export_ply", { name: studio.name }) },
        { label: "Web page", press: () => ask("export_page", { name: studio.name, pose: true }) },
        { label: "Picture, png", press: () => studio.picture() }] },
    ] },
  ];
}
