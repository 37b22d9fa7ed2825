// One WebSocket to the ground, opened again by itself; it also learns what the ground's clock says.

/** @typedef {{type: string, [key: string]: any}} Message */

const PAUSES_MS = [300, 1000, 2000, 4000];
const SILENT_MS = 6000;
const NOTHING = new Uint8Array(0);

export class Connection {
  /**
   * @param {(message: Message, payload: Uint8Array) => void} onMessage empty where there is none
   * @param {(state: "connected" | "waiting", why: string) => void} onState why it is refused, where the ground says so
   */
  constructor(onMessage, onState) {
    this.onMessage = onMessage;
    this.onState = onState;
    /** @type {WebSocket | null} */
    this.socket = null;
    this.tries = 0;
    this.heard = 0;
    /** Why the ground ended the last connection, in its words. */
    this.why = "";
    /** Of the exchanges so far: the shortest, and what it said. */
    this.roundTrip = Infinity;
    this.ahead = 0;
    setInterval(() => this.check(), 2000);
    this.open();
  }

  /** The ground's time, Unix milliseconds. */
  now() {
    return performance.timeOrigin + performance.now() + this.ahead;
  }

  /** @param {Message} message */
  send(message) {
    if (this.socket && this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  open() {
    const socket = new WebSocket(new URL("ws", location.href.replace(/^http/, "ws")));
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.heard = performance.now();
    socket.onopen = () => {
      this.tries = 0;
      this.why = "";
      this.roundTrip = Infinity;
      this.onState("connected", "");
      this.askTime();
    };
    socket.onmessage = (event) => {
      this.heard = performance.now();
      if (typeof event.data === "string") this.take(JSON.parse(event.data), NOTHING);
      else this.take(...unpacked(event.data));
    };
    socket.onclose = (event) => {
      if (this.socket !== socket) return;
      this.socket = null;
      if (event.code === 1008) this.why = event.reason;
      this.onState("waiting", this.why);
      if (performance.now() - this.heard < 1000) this.askWhy();
      setTimeout(() => this.open(), PAUSES_MS[Math.min(this.tries++, PAUSES_MS.length - 1)]);
    };
  }

  /** @param {Message} message @param {Uint8Array} payload */
  take(message, payload) {
    if (message.type === "hello") this.ahead = message.now - (performance.timeOrigin + performance.now()); // until it is known better
    if (message.type !== "time") {
      this.onMessage(message, payload);
      return;
    }
    const local = performance.timeOrigin + performance.now();
    const roundTrip = local - message.sent;
    if (roundTrip < this.roundTrip) {
      this.roundTrip = roundTrip;
      this.ahead = message.now - (message.sent + roundTrip / 2);
    }
    this.roundTrip *= 1.1; // an old answer counts less than a new one
  }

  /** A WebSocket that is refused tells no page why; the same question as a command is answered in words. */
  async askWhy() {
    try {
      const reply = await fetch("ws", { method: "POST" });
      if ((reply.status === 401 || reply.status === 403) && !this.socket) this.onState("waiting", (this.why = (await reply.text()).slice(0, 300)));
    } catch {
      // there is no ground at all
    }
  }

  askTime() {
    this.send({ type: "time", sent: performance.timeOrigin + performance.now() });
  }

  check() {
    if (!this.socket || this.socket.readyState !== WebSocket.OPEN) return;
    if (performance.now() - this.heard > SILENT_MS) this.socket.close();
    else this.askTime();
  }
}

/**
 * The length of the head in two bytes, the head, the payload.
 * @param {ArrayBuffer} data
 * @returns {[Message, Uint8Array]}
 */
export function unpacked(data) {
  const length = new DataView(data).getUint16(0);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 2, length)));
  return [head, new Uint8Array(data, 2 + length)];
}
