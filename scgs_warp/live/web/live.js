// A page whose scene comes from a server, and changes while the page is open.

class Updates {
  constructor() {
    this.version = 0;
    this.shown = 0;
    this.losses = 0;
    this.first = new Promise((resolve) => { this.arrived = resolve; });
    this.status = "";
    this.wire = new Wire((data) => this.hear(JSON.parse(data)), (answers) => this.gone(answers), undefined,
      (on) => this.tell(on ? `${SILENT} The page shows what it has.` : this.status));
  }

  hear({ version, status }) {
    this.version = version;
    this.status = status;
    if (!this.player && !version) say(status);
    else this.tell(status);
    if (version) this.arrived();
    this.refresh();
  }

  gone(answers) {
    this.tell(answers ? STRANGE : "The server has gone. The page shows what it has, and tries to reach it again.");
    this.losses++;
    this.version = this.shown = 0; // another server begins to count again
  }

  tell(text) {
    element("status").textContent = text;
    element("status").hidden = !text;
  }

  async load(report) {
    say("Waiting for the server");
    await this.first;
    this.shown = this.version;
    return fetchedScene("scene", report);
  }

  // Fetch the newest scene; one at a time.
  async refresh() {
    if (!this.player || this.loading || this.shown === this.version) return;
    this.loading = true;
    const { version, losses } = this;
    let done = false;
    try {
      const model = await readModel(await fetchedScene("scene", () => {}));
      this.player.take(model);
      showModel(this.player);
      if (losses === this.losses) this.shown = version;
      done = true;
    } catch (error) {
      if (this.wire.open) this.tell(error.message);
    }
    this.loading = false;
    if (done) this.refresh();
  }
}

const updates = new Updates();
const started = startPage((report) => updates.load(report), (player) => {
  updates.player = player;
  updates.refresh();
  return {};
});
started.catch(() => { updates.wire.broken = true; });
publish(started);
