// The websocket: what comes, and what this client looks at.

const KINDS = { u1: Uint8Array, f4: Float32Array, f8: Float64Array };

/** Header and arrays of a message; the arrays are views of it. */
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let start = 4 + length;
  const arrays = {};
  for (const [name, kind, count] of header.arrays) {
    arrays[name] = new KINDS[kind](buffer, start, count);
    start += Math.ceil(arrays[name].byteLength / 8) * 8;
  }
  return [header, arrays];
}

/** Connects, and connects again; `on[kind](header, arrays)` takes what comes. */
export class Feed {
  constructor(on, connected) {
    this.on = on;
    this.connected = connected;
    this.wishes = {};
    this.wait_ms = 500;
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.wait_ms = 500;
      this.connected(true);
      socket.send(JSON.stringify(this.wishes));
    };
    socket.onmessage = (event) => {
      const [header, arrays] = unpack(event.data);
      this.on[header.kind]?.(header, arrays);
    };
    socket.onclose = () => {
      this.connected(false);
      setTimeout(() => this.open(), this.wait_ms);
      this.wait_ms = Math.min(2 * this.wait_ms, 8000);
    };
    this.socket = socket;
  }

  /** Change what is looked at. */
  wish(wishes) {
    this.wishes = { ...this.wishes, ...wishes };
    this.send(this.wishes);
  }

  /** Confirm a picture; the next may come. */
  seen() {
    this.send({ seen: true });
  }

  send(content) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(content));
  }
}
