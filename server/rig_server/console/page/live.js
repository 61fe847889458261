// The connection to the rig: states as JSON, pictures as binary messages; it comes back by itself.

const WAIT_MS = [500, 1000, 2000, 5000];

export class Live extends EventTarget {
  #socket = null;
  #failures = 0;
  #look = null;

  connect() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    this.#socket = new WebSocket(`${scheme}//${location.host}/live`);
    this.#socket.binaryType = "arraybuffer";
    this.#socket.onopen = () => {
      this.#failures = 0;
      this.#tell("connected", true);
      this.#sendLook();
    };
    this.#socket.onmessage = (event) => this.#hear(event.data);
    this.#socket.onclose = () => {
      this.#tell("connected", false);
      const wait = WAIT_MS[Math.min(this.#failures++, WAIT_MS.length - 1)];
      setTimeout(() => this.#again(), wait);
    };
  }

  // A server that was started anew may have another token: its door asks for it.
  async #again() {
    try {
      const answer = await fetch("/", { method: "HEAD" });
      if (answer.status === 401) {
        location.reload();
        return;
      }
    } catch {
      // Nobody is there yet.
    }
    this.connect();
  }

  // What the page shows: {mode, enlarged}; null while it is hidden.
  look(look) {
    this.#look = look;
    this.#sendLook();
  }

  painted(number) {
    this.#say({ say: "painted", number });
  }

  #sendLook() {
    this.#say({ say: "look", ...(document.hidden || !this.#look ? {} : this.#look) });
  }

  #say(words) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(words));
  }

  #hear(data) {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      this.#tell(message.kind, message);
      return;
    }
    const headerBytes = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, headerBytes)));
    this.#tell(header.kind, { ...header, data, start: 4 + headerBytes });
  }

  #tell(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }
}

export function picture(data, start, bytes) {
  return createImageBitmap(new Blob([new Uint8Array(data, start, bytes)], { type: "image/jpeg" }));
}

export function paint(canvas, bitmap) {
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
  }
  canvas.getContext("2d", { alpha: false }).drawImage(bitmap, 0, 0);
}

export function nextFrame() {
  return new Promise((done) => requestAnimationFrame(done));
}
