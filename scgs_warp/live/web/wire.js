// Connection to the page's server. After it is lost, it is opened again as soon as the server answers.

const RETRY = 1000; // milliseconds, doubled up to eight times as long

class Wire {
  // heard(data): a text or an ArrayBuffer has come. gone(): the connection is lost, or could not be opened.
  constructor(heard, gone) {
    this.heard = heard;
    this.gone = gone;
    this.delay = RETRY;
    this.open = false;
    this.connect();
  }

  connect() {
    const address = new URL("socket", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    address.search = "";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.open = true;
      this.delay = RETRY;
    };
    this.socket.onmessage = ({ data }) => this.heard(data);
    this.socket.onclose = () => {
      this.open = false;
      this.gone();
      setTimeout(() => this.connect(), this.delay);
      this.delay = Math.min(8 * RETRY, 2 * this.delay);
    };
  }

  send(message) {
    this.socket.send(JSON.stringify(message));
  }
}
