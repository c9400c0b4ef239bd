// Connection to the page's server. After it is lost, it is opened again as soon as the server answers.

const RETRY = 1000; // milliseconds, doubled up to four times as long
const ANSWER = 5000; // milliseconds that a server may take
const BEAT = 2000; // milliseconds between questions whether it is there

const STRANGE = "A server answers again, but it does not know this page. Open the address that it has printed, here or in another tab.";

const SILENT = "The server does not answer.";

const toHex = (bytes) => [...new Uint8Array(bytes)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
const toBytes = (hex) => Uint8Array.from(hex.match(/../g), (pair) => parseInt(pair, 16));

// Prove to the server of a later start that this page knows its secret, which gives the page its cookie; the server
// proves the same first (scgs_warp/live/return_key.py). Resolves with whether there is a server.
async function findWayBack(back) {
  const ask = (query) => fetch(`return?${new URLSearchParams(query)}`, { cache: "no-store", signal: AbortSignal.timeout(ANSWER) });
  try {
    const drawn = toHex(crypto.getRandomValues(new Uint8Array(32)));
    const answer = await ask({ drawn });
    if (!back || !answer.ok || !crypto.subtle) return true;
    const { start, proof } = await answer.json();
    const key = await crypto.subtle.importKey("raw", toBytes(back.key), { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
    const prove = async (of) => toHex(await crypto.subtle.sign("HMAC", key,
      new TextEncoder().encode(`${of} ${back.port} ${drawn} ${start}`)));
    if (proof === await prove("server")) await ask({ drawn, proof: await prove("page") });
    return true;
  } catch {
    return false;
  }
}

class Wire {
  // heard(data): a text or an ArrayBuffer has come. gone(answers): the connection is lost, or could not be opened;
  // answers: a server is there, and refuses this page. moved(): the server shows another scene, or another program.
  // silent(on): the server has not answered for some time, though the connection stands; or it does again.
  constructor(heard, gone, moved = () => location.reload(), silent = () => {}) {
    Object.assign(this, { heard, gone, moved, silent });
    this.quiet = false;
    this.beaten = null; // when the server was asked whether it is there, until it says anything
    this.delay = RETRY;
    this.open = false;
    this.back = null; // secret for the way back
    this.broken = false; // the page could not begin: it does so when the server is back
    this.connect();
    setInterval(() => this.beat(), BEAT);
  }

  // Ask whether the server is there; a stopped one leaves connections open.
  beat() {
    if (!this.open) return;
    if (this.beaten === null) {
      this.beaten = performance.now();
      this.send({ do: "beat" });
    } else if (!this.quiet && performance.now() - this.beaten > ANSWER) {
      this.silent(true); // may still send something
      this.quiet = true;
    }
  }

  heardAnything() {
    this.beaten = null;
    if (!this.quiet) return;
    this.quiet = false;
    this.silent(false);
  }

  connect(answers = false) {
    const address = new URL("socket", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    address.search = "";
    let opened = false;
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.open = opened = true;
      this.beaten = null;
      this.delay = RETRY;
    };
    this.socket.onmessage = ({ data }) => this.hear(data);
    this.socket.onclose = () => {
      this.open = this.quiet = false;
      this.gone(answers && !opened);
      setTimeout(() => this.retry(), this.delay);
      this.delay = Math.min(4 * RETRY, 2 * this.delay);
    };
  }

  async retry() {
    const answers = await findWayBack(this.back);
    this.connect(answers);
  }

  hear(data) {
    this.heardAnything();
    const { server, beat } = typeof data === "string" ? JSON.parse(data) : {};
    if (beat) return;
    if (!server) return this.heard(data);
    if (this.page && (this.broken || server.page !== this.page)) return this.moved();
    this.page = server.page;
    this.back = server.back;
  }

  send(message) {
    this.socket.send(JSON.stringify(message));
  }
}
