// Changes of the parts themselves: another name, two parts as one, one part as two, another parent.

const isolated = (name) => `\u2068${name}\u2069`; // a name may be written from right to left

class PartChanges {
  constructor(studio) {
    this.studio = studio;
    element("chosen").addEventListener("click", () => this.rename());
    // The second press of a double click; its release meets no track that has been drawn anew meanwhile.
    element("tracks").addEventListener("mousedown", (event) => {
      const name = event.target.closest(".name")?.dataset.handle;
      const handle = this.state.handles.find((one) => one.name === name);
      if (!handle || event.detail !== 2 || event.button !== 0) return;
      event.preventDefault(); // the dialog keeps the focus
      this.rename(handle.part ?? handle.name, Boolean(handle.part));
    });
    element("change").addEventListener("submit", (event) => {
      event.preventDefault();
      this.send();
    });
    element("keepit").addEventListener("click", () => element("changes").close());
  }

  get state() {
    return this.studio.link.state;
  }

  // Parts with which one can be merged: those that share its joint or its parent.
  neighbours(name) {
    const { parts } = this.studio.tools, row = parts.findIndex((part) => part.name === name), above = parts[row]?.parent;
    return row < 0 ? [] : parts.filter((part, other) => other !== row
      && (other === above || part.parent === row || (above >= 0 && part.parent === above))).map((part) => part.name);
  }

  // Parts on which one can hang: all but itself, those that hang on it, and the present one. The empty name: none.
  supports(name) {
    const { parts } = this.studio.tools, row = parts.findIndex((part) => part.name === name), above = parts[row]?.parent;
    const below = (other) => other >= 0 && (other === row || below(parts[other].parent));
    if (row < 0) return [];
    const others = parts.filter((part, other) => other !== above && !below(other)).map((part) => part.name);
    return above >= 0 ? ["", ...others] : others;
  }

  rename(name = this.state.part ?? this.state.active, part = Boolean(this.state.part)) {
    if (!name) return;
    const known = part ? null : this.state.handles.find((handle) => handle.name === name)?.part;
    if (known) return this.rename(known, true); // its handle has the part's name on the page
    this.ask({ title: part ? "Rename the part" : "Rename the handle", label: "Name", value: name, verb: "Rename",
      send: (to) => ["rename_" + (part ? "part" : "handle"), { name, to }] });
  }

  merge() {
    const name = this.state.part, options = this.neighbours(name);
    if (!options.length) return;
    this.ask({ title: `Merge ${isolated(name)}`, label: "With", options, verb: "Merge",
      send: (other) => ["merge_parts", { name, other }] });
  }

  attach() {
    const name = this.state.part, options = this.supports(name);
    if (!options.length) return;
    this.ask({ title: `Attach ${isolated(name)}`, label: "To", options, verb: "Attach",
      send: (other) => ["attach_part", other ? { name, other } : { name }] });
  }

  split() {
    const { parts } = this.studio.tools, taken = new Set(parts.map((part) => part.name));
    let number = 1;
    while (taken.has(`part-${number}`)) number++;
    this.ask({ title: "Split the chosen control points off", label: "Name of the new part", value: `part-${number}`, verb: "Split",
      send: (to) => ["split_part", { to }] });
  }

  // Ask for a name or, of some, one.
  ask({ title, label, value, options, verb, send }) {
    const name = element("newname"), other = element("other");
    this.request = () => send(options ? other.value : name.value);
    element("changing").textContent = title;
    element("newlabel").textContent = label;
    element("newlabel").htmlFor = options ? "other" : "newname";
    element("doit").textContent = verb;
    element("refused").textContent = "";
    name.hidden = Boolean(options);
    other.hidden = !options;
    other.replaceChildren(...(options ?? []).map((one) => new Option(one || "nothing", one)));
    name.value = value ?? "";
    element("changes").showModal();
    (options ? other : name).focus();
    if (!options) name.select();
  }

  async send() {
    const [what, fields] = this.request(), { studio } = this;
    element("doit").disabled = true;
    const { problem } = await studio.link.ask(what, { at: studio.player.at, ...fields }, true);
    element("doit").disabled = false;
    element("refused").textContent = problem ?? "";
    if (!problem) element("changes").close();
  }

  // What is chosen, over the picture.
  show({ part, selection, active, handles }) {
    const chip = element("chosen"), count = selection.length;
    const handle = handles.find((one) => one.name === active), name = part ?? handle?.part ?? handle?.name;
    chip.hidden = !count;
    chip.disabled = !name;
    chip.textContent = name ?? `${count} control point${count === 1 ? "" : "s"}`;
    chip.title = name ? `${name}: another name (F2)` : "";
  }
}
