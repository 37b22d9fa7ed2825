// Boxes and names on the picture, in step with it; a click or a drag is a box too.

/** @typedef {{id: number, box: number[], name: string, sureness: number, read?: 1, doubted?: 1, sure?: 1}} Track */
/** @typedef {{frame: number, captured: number, tracks: Track[]}} Overlay */

const MOST = 4000;
const OLD_MS = 500; // a list so old says nothing of this picture
const FADED_MS = 200;
const CLICK_SHARE = 0.12; // of the picture's width: what a click beside all boxes asks for
const COLOURS = ["#4cc9f0", "#ffd166", "#f78c6b", "#83e377", "#c77dff", "#ff8fab", "#72efdd", "#e9c46a"];

export class Boxes {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {(box: number[], track: Track | null) => void} onPick in base pixels
   */
  constructor(canvas, onPick) {
    this.canvas = canvas;
    this.onPick = onPick;
    /** @type {Map<number, Overlay>} */
    this.overlays = new Map();
    this.size = [16, 9];
    this.frame = -1;
    this.captured = 0;
    /** @type {number[] | null} */
    this.drag = null;
    /** @type {number[] | null} */
    this.marked = null;
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      canvas.setPointerCapture(event.pointerId);
      this.drag = [...this.place(event), ...this.place(event)];
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.drag) return;
      this.drag.splice(2, 2, ...this.place(event));
      this.draw();
    });
    canvas.addEventListener("pointerup", (event) => this.finish(event));
    canvas.addEventListener("pointercancel", () => {
      this.drag = null;
      this.draw();
    });
  }

  reset() {
    this.overlays.clear();
    this.frame = -1;
    this.marked = null;
    this.draw();
  }

  /** @param {Overlay} overlay */
  add(overlay) {
    this.overlays.set(overlay.frame, overlay);
    if (this.overlays.size > MOST) this.overlays.delete(this.overlays.keys().next().value);
    if (overlay.frame <= this.frame) this.draw();
  }

  /** @param {{frame: number, captured: number}} picture */
  show(picture) {
    this.frame = picture.frame;
    this.captured = picture.captured;
    this.draw();
  }

  /** The list of this picture, or the newest of those shortly before it. */
  current() {
    for (let frame = this.frame; frame > this.frame - 30 && frame >= 0; frame--) {
      const found = this.overlays.get(frame);
      if (found) return this.captured - found.captured < OLD_MS ? found : null;
    }
    return null;
  }

  /** @param {number[] | null} box a place that is asked for */
  mark(box) {
    this.marked = box;
    this.draw();
  }

  draw() {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio);
    const height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const context = canvas.getContext("2d");
    if (!context || !width) return;
    context.clearRect(0, 0, width, height);
    const scale = width / this.size[0];
    const letter = (width / ratio < 500 ? 9 : 12) * ratio;
    context.font = `${letter}px system-ui, sans-serif`;
    const list = this.current();
    context.globalAlpha = list && this.captured - list.captured > FADED_MS ? 0.5 : 1;
    /** @type {number[][]} */
    const taken = [];
    for (const track of list?.tracks ?? []) {
      this.drawBox(context, track, scale, ratio);
      if (!track.doubted) this.drawName(context, track, scale, letter, taken);
    }
    context.globalAlpha = 1;
    for (const box of [this.marked, this.drag && sorted(this.drag)]) {
      if (!box) continue;
      context.setLineDash([6 * ratio, 4 * ratio]);
      context.lineWidth = 2 * ratio;
      context.strokeStyle = "#fff";
      context.strokeRect(box[0] * scale, box[1] * scale, (box[2] - box[0]) * scale, (box[3] - box[1]) * scale);
    }
    context.setLineDash([]);
  }

  /** @param {CanvasRenderingContext2D} context @param {Track} track @param {number} scale @param {number} ratio */
  drawBox(context, track, scale, ratio) {
    const [x, y, right, bottom] = track.box.map((value) => value * scale);
    context.strokeStyle = colourOf(track);
    context.lineWidth = (track.read ? 3 : 1.5) * ratio;
    context.setLineDash(track.doubted ? [4 * ratio, 4 * ratio] : []);
    if (track.doubted) context.lineWidth = ratio;
    context.strokeRect(x, y, right - x, bottom - y);
    context.setLineDash([]);
  }

  /**
   * Names that would cover one another are left out.
   * @param {CanvasRenderingContext2D} context @param {Track} track @param {number} scale @param {number} letter
   * @param {number[][]} taken
   */
  drawName(context, track, scale, letter, taken) {
    const words = track.name + (track.sure ? " ✓" : "");
    const height = letter * 1.35;
    const width = context.measureText(words).width + letter * 0.5;
    const x = track.box[0] * scale;
    const top = track.box[1] * scale > height ? track.box[1] * scale - height : track.box[3] * scale;
    const right = x + width;
    const bottom = top + height;
    if (taken.some(([l, t, r, b]) => x < r && right > l && top < b && bottom > t)) return;
    taken.push([x, top, right, bottom]);
    context.fillStyle = "#000a";
    context.fillRect(x, top, width, height);
    context.fillStyle = colourOf(track);
    context.fillText(words, x + letter * 0.25, top + letter);
  }

  /** @param {PointerEvent} event */
  place(event) {
    const area = this.canvas.getBoundingClientRect();
    const x = ((event.clientX - area.left) / area.width) * this.size[0];
    const y = ((event.clientY - area.top) / area.height) * this.size[1];
    return [Math.max(0, Math.min(this.size[0], x)), Math.max(0, Math.min(this.size[1], y))];
  }

  /** @param {PointerEvent} event */
  finish(event) {
    if (!this.drag) return;
    const box = sorted(this.drag);
    this.drag = null;
    const little = this.size[0] / 100;
    if (box[2] - box[0] > little && box[3] - box[1] > little) {
      this.onPick(box, null);
      return;
    }
    const [x, y] = this.place(event);
    const hit = (this.current()?.tracks ?? [])
      .filter(({ box: [left, top, right, bottom] }) => x >= left && x <= right && y >= top && y <= bottom)
      .sort((one, other) => area(one.box) - area(other.box))[0];
    if (hit) this.onPick(hit.box, hit);
    else {
      const half = (this.size[0] * CLICK_SHARE) / 2;
      this.onPick([x - half, y - half, x + half, y + half], null);
    }
  }
}

/** @param {number[]} box */
const area = (box) => (box[2] - box[0]) * (box[3] - box[1]);

/** @param {number[]} drag */
const sorted = ([x1, y1, x2, y2]) => [Math.min(x1, x2), Math.min(y1, y2), Math.max(x1, x2), Math.max(y1, y2)];

/** @param {Track} track */
const colourOf = (track) => COLOURS[hashed(track.name) % COLOURS.length];

/** @param {string} name */
function hashed(name) {
  let sum = 7;
  for (const letter of name) sum = (sum * 31 + letter.charCodeAt(0)) >>> 0;
  return sum;
}
