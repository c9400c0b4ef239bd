// Brings a scene's bytes into the page, with the share that has arrived.

const nextTurn = () => new Promise((resolve) => setTimeout(resolve)); // lets the browser draw and answer
const PATIENCE = 50; // milliseconds between looks at a file that is still being read

class Inflater {
  constructor() {
    const stream = new DecompressionStream("deflate");
    this.writer = stream.writable.getWriter();
    this.result = this.collect(stream.readable.getReader());
    this.result.catch(() => {}); // finish() reports it
  }

  async collect(reader) {
    const parts = [];
    let size = 0;
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      parts.push(value);
      size += value.length;
    }
    const whole = new Uint8Array(size);
    let offset = 0;
    for (const part of parts) {
      whole.set(part, offset);
      offset += part.length;
    }
    return whole;
  }

  push(bytes) {
    return this.writer.write(bytes);
  }

  async finish() {
    await this.writer.close();
    return this.result;
  }
}

function decodeBase64(text) {
  const letters = atob(text), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

// The bytes that follow this program in the same file, as `count` elements. They are taken as the browser reads them.
async function embeddedScene(count, report) {
  const inflater = new Inflater();
  for (let k = 0; k < count; k++) {
    let part = document.querySelector("script.data");
    while (!part || (!part.nextElementSibling && document.readyState === "loading")) {
      await new Promise((resolve) => setTimeout(resolve, PATIENCE));
      part = document.querySelector("script.data");
      if (!part && document.readyState !== "loading") throw new Error("The file is not complete: load it again.");
    }
    await inflater.push(decodeBase64(part.textContent));
    part.remove(); // decoded, and long
    report((k + 1) / count);
    await nextTurn();
  }
  return inflater.finish();
}

// The bytes at an address. Browsers describe a lost connection in words of their own, such as "Failed to fetch".
async function fetchedScene(address, report) {
  const lost = () => { throw new Error("The connection to the server was lost before the scene had arrived."); };
  const response = await fetch(address, { cache: "no-store" }).catch(lost);
  if (!response.ok) throw new Error(`The server refuses the scene (${response.status}): ${await response.text()}`);
  const size = Number(response.headers.get("Content-Length")), reader = response.body.getReader();
  const inflater = new Inflater();
  let arrived = 0;
  for (;;) {
    const { done, value } = await reader.read().catch(lost);
    if (done) break;
    await inflater.push(value);
    arrived += value.length;
    if (size) report(Math.min(1, arrived / size));
  }
  return inflater.finish();
}
