// A page whose scene comes from a server, and changes while the page is open.

class Updates {
  constructor() {
    this.version = 0;
    this.shown = 0;
    this.first = new Promise((resolve) => { this.arrived = resolve; });
    new Wire((data) => this.hear(JSON.parse(data)), () => this.gone());
  }

  hear({ version, status }) {
    this.version = version;
    if (!this.player && !version) say(status);
    else this.tell(status);
    if (version) this.arrived();
    this.refresh();
  }

  gone() {
    this.tell("The server has gone. The page shows what it has, and waits for it.");
    this.shown = 0; // another server begins to count again
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
    const version = this.version;
    try {
      const model = await readModel(await fetchedScene("scene", () => {}));
      this.player.take(model);
      showModel(this.player);
      this.shown = version;
    } catch (error) {
      this.tell(error.message);
    }
    this.loading = false;
    if (this.shown === version) this.refresh();
  }
}

const updates = new Updates();
publish(startPage((report) => updates.load(report), (player) => {
  updates.player = player;
  updates.refresh();
  return {};
}));
