// Every action with its name and key: buttons, keys, the palette and the list of keys are made from this one table.

function commandTable(studio) {
  const { link, player, clock, tools, timeline } = studio;
  const ask = (what, fields = {}) => link.ask(what, { at: player.at, ...fields });
  const chosen = () => link.state?.selection.length > 0, step = (by) => () => {
    clock.play(false);
    player.seek(player.time + by / Math.max(1, player.seconds * player.fps));
  };
  const view = (change) => () => {
    followFilm(player, false);
    change(player.orbit);
    player.changed();
  };
  return [
    ["play", "Play or pause", " ", () => clock.play(!clock.playing)],
    ["key", "Key the pose here", "k", () => ask("key"), () => link.state?.handles.length > 0],
    ["undo", "Undo", "ctrl+z", () => ask("undo"), () => link.state?.undo],
    ["redo", "Redo", "ctrl+y", () => ask("redo"), () => link.state?.redo],
    ["redo-too", "Redo", "ctrl+shift+z", () => ask("redo"), () => link.state?.redo],
    ["tool-pull", "Tool: pull parts", "1", () => studio.use("pull")],
    ["grab", "Grab: pull parts", "g", () => studio.use("pull")],
    ["tool-turn", "Tool: turn parts about their joints", "2", () => studio.use("turn")],
    ["rotate", "Rotate: turn parts", "r", () => studio.use("turn")],
    ["tool-points", "Tool: choose control points", "3", () => studio.use("points")],
    ["pivot", "Put the pivot of the rings back", ".", () => tools.pivot.reset(), () => Boolean(tools.pivot?.place())],
    ["rename", "Rename the chosen part or handle", "F2", () => studio.changes.rename(), () => link.state?.part || link.state?.active],
    ["merge", "Merge the chosen part with a neighbour", "", () => studio.changes.merge(),
      () => link.state?.part && studio.changes.neighbours(link.state.part).length],
    ["attach", "Attach the chosen part to another one", "", () => studio.changes.attach(),
      () => link.state?.part && studio.changes.supports(link.state.part).length],
    ["split", "Split the chosen control points off as a part", "", () => studio.changes.split(), () => chosen() && !link.state.part],
    ["hold", "Hold the selection as it is now", "h", () => ask("hold", { frame: studio.holdFrame }), chosen],
    ["frame", "Frame the scene", "f", () => studio.frame()],
    ["left", "Turn the view to the left", "shift+ArrowLeft", view((orbit) => orbit.turn(-0.05, 0))],
    ["right", "Turn the view to the right", "shift+ArrowRight", view((orbit) => orbit.turn(0.05, 0))],
    ["up", "Turn the view up", "shift+ArrowUp", view((orbit) => orbit.turn(0, 0.05))],
    ["down", "Turn the view down", "shift+ArrowDown", view((orbit) => orbit.turn(0, -0.05))],
    ["nearer", "Bring the view nearer", "shift+PageUp", view((orbit) => orbit.zoom(0.9))],
    ["farther", "Take the view farther away", "shift+PageDown", view((orbit) => orbit.zoom(1 / 0.9))],
    ["cancel", "Cancel, or choose nothing", "Escape", () => tools.cancel()],
    ["delete", "Delete the chosen key, else the handle", "Delete",
      () => (timeline.chosen ? timeline.remove() : ask("remove")), () => timeline.chosen || link.state?.active],
    ["all", "Choose all control points", "ctrl+a", () => ask("select", { what: "all" })],
    ["grow", "Grow the selection", "+", () => ask("select", { what: "grow" }), chosen],
    ["back", "One frame back", "ArrowLeft", step(-1)],
    ["forth", "One frame forth", "ArrowRight", step(1)],
    ["begin", "First frame", "Home", () => player.seek(0)],
    ["end", "Last frame", "End", () => player.seek(1)],
    ["camera", "Look through the film's camera", "c", () => followFilm(player, !player.follows)],
    ["view", "Add this view to the path of the film's camera", "v", () => ask("shot", { kind: "orbit", ...studio.view() })],
    ["original", "Show the original (O: while held)", "o", () => studio.compare(!player.original)],
    ["points", "Show control points", "p", () => studio.display("points", !tools.show.points)],
    ["ribbons", "Show trajectories", "t", () => studio.display("ribbons", !tools.show.ribbons)],
    ["black", "Black or white background", "b", () => studio.paint(player.background[0] < 0.5 ? [1, 1, 1] : [0, 0, 0])],
    ["reset", "Remove the whole edit", "", () => ask("reset"), () => link.state && !link.state.unedited],
    ["save", "Save a copy of the edit", "ctrl+s", () => studio.save()],
    ["share", "Share: write a web page that plays the edit", "", () => studio.share()],
    ["film", "Export the film", "", () => ask("export_film", { name: studio.name, format: ".mp4" })],
    ["picture", "Save a picture of the view", "", () => studio.picture()],
    ["theme", "Dark or light page", "",
      () => studio.theme(document.body.classList.contains("light") ? "dark" : "light")],
    ["panel", "Show or hide the panel", "n", () => studio.fold()],
    ["palette", "Search all commands", "ctrl+k", () => studio.palette()],
    ["keys", "Show all keys", "?", () => showKeys()],
  ].map(([id, label, key, run, when]) => ({ id, label, key, run, when: when ?? (() => true) }));
}

function showKeys() {
  element("keys").showModal();
  element("keys").scrollTop = 0; // the button at its end has the focus
}

const KEY_NAMES = { " ": "Space", ArrowLeft: "\u2190", ArrowRight: "\u2192", ArrowUp: "\u2191", ArrowDown: "\u2193",
  PageUp: "Page up", PageDown: "Page down", Escape: "Esc" };
const named = (part) => KEY_NAMES[part] ?? part[0].toUpperCase() + part.slice(1);
const keyText = (key) => (key === "+" ? "+" : key.split("+").filter(Boolean).map(named).join("+"));

class Commands {
  constructor(studio) {
    this.list = commandTable(studio);
    this.busy = () => Boolean(studio.tools.drag);
    for (const button of document.querySelectorAll("[data-command]")) {
      const command = this.list.find(({ id }) => id === button.dataset.command);
      button.title = command.key ? `${command.label} (${keyText(command.key)})` : command.label;
      button.addEventListener("click", () => command.run());
    }
    element("keylist").replaceChildren(...this.list.filter(({ key }) => key).flatMap(({ key, label }) => {
      const name = document.createElement("dt"), text = document.createElement("dd");
      name.append(Object.assign(document.createElement("kbd"), { textContent: keyText(key) }));
      text.textContent = label;
      return [name, text];
    }));
    document.addEventListener("keydown", (event) => this.press(event));
    document.addEventListener("keyup", (event) => event.key.toLowerCase() === "o" && studio.compare(false));
    addEventListener("blur", () => studio.compare(false)); // a key that is let go in another window is not heard of
    element("sought").addEventListener("input", () => this.search());
    element("sought").addEventListener("keydown", (event) => this.walk(event));
  }

  press(event) {
    if (event.altKey || event.defaultPrevented || document.querySelector("dialog[open]")) return;
    const typed = /^(input|select|textarea)$/i.test(event.target.tagName) && event.target.type !== "checkbox"
      && !event.target.closest("dialog:not([open])"); // it keeps the focus until the next frame
    const pressed = /^( |Enter)$/.test(event.key) && event.target.matches("button, summary, [type=checkbox]");
    const control = event.ctrlKey || event.metaKey;
    if ((typed && !(control && /[zyk]/i.test(event.key) && event.target.type !== "text")) || pressed) return;
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const plain = (control ? "ctrl+" : "") + (event.shiftKey && (control || /^(Arrow|Page)/.test(name)) ? "shift+" : "") + name;
    const command = this.list.find(({ key }) => key === plain || (key === "Delete" && plain === "Backspace"));
    if (!command) return;
    event.preventDefault();
    if (this.busy() && command.id !== "cancel") return; // the drag ends first
    if (command.when() && !(event.repeat && /^(play|original|delete)$/.test(command.id))) command.run();
  }

  show() {
    for (const button of document.querySelectorAll("[data-command]")) {
      const command = this.list.find(({ id }) => id === button.dataset.command);
      button.disabled = !command.when();
    }
  }

  open() {
    element("sought").value = "";
    this.search();
    element("palette").showModal();
    element("sought").focus();
  }

  search() {
    const words = element("sought").value.toLowerCase().split(/\s+/);
    this.found = this.list.filter(({ id, label }) => id !== "redo-too" && id !== "palette"
      && words.every((word) => label.toLowerCase().includes(word)));
    this.at = 0;
    element("found").replaceChildren(...this.found.map((command, k) => {
      const row = document.createElement("li"), key = document.createElement("kbd");
      row.id = `found-${k}`;
      row.setAttribute("role", "option");
      row.setAttribute("aria-disabled", String(!command.when()));
      key.textContent = keyText(command.key);
      row.append(command.label, key);
      row.addEventListener("click", () => this.run(k));
      return row;
    }));
    this.mark();
  }

  mark() {
    [...element("found").children].forEach((row, k) => row.setAttribute("aria-selected", String(k === this.at)));
    element("sought").setAttribute("aria-activedescendant", this.found.length ? `found-${this.at}` : "");
    element("found").children[this.at]?.scrollIntoView({ block: "nearest" });
  }

  walk(event) {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (by) {
      event.preventDefault();
      this.at = (this.at + by + this.found.length) % Math.max(1, this.found.length);
      this.mark();
    }
    if (event.key === "Enter") {
      event.preventDefault();
      this.run(this.at);
    }
  }

  run(k) {
    element("sought").blur(); // keys are the page's again at once
    element("palette").close();
    const command = this.found[k];
    if (command?.when()) command.run();
  }
}
