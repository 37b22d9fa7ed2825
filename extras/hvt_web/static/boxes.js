// Boxes and names on the picture, in step with it; a click or a drag is a box too.

import { boxWords } from "./words.js";

/** @typedef {{id: number, box: number[], name: string, sureness: number, read?: 1, doubted?: 1, sure?: 1}} Track */
/** @typedef {{frame: number, captured: number, looked: number, tracks: Track[], colours: Record<string, string>}} Overlay */

const MOST = 4000;
export const OLD_MS = 500; // a list so old says nothing of this picture
const LOOK_BACK = 900; // frames
const PACE_FRAMES = 5; // over so many a track's pace is taken: a box that was put right is no motion
const FADED_MS = 200;
const CLICK_SHARE = 0.12; // of the picture's width: what a click beside all boxes asks for
const CROWD = 30; // objects: from so many on only names that matter are written
const TAP_MS = 500;
const TAP_PX = 10;

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
    this.shown = true;
    /**
     * Classes that are not drawn.
     * @type {Set<string>}
     */
    this.left = new Set();
    /**
     * Of classes, as in the recording.
     * @type {Map<string, string>}
     */
    this.colours = new Map();
    this.downAt = 0;
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || !event.isPrimary) return;
      this.downAt = event.timeStamp;
      if (event.pointerType === "mouse") canvas.setPointerCapture(event.pointerId);
      this.drag = [...this.place(event), ...this.place(event)];
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.drag) return;
      this.drag.splice(2, 2, ...this.place(event));
      if (event.pointerType === "mouse") this.draw();
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
    this.captured = 0;
    this.marked = this.drag = null;
    this.draw();
  }

  /** @param {Overlay} overlay */
  add(overlay) {
    for (const [name, colour] of Object.entries(overlay.colours)) this.colours.set(name, colour);
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

  /** The list of this picture, or the newest of those shortly before it, whose tracks go on at their pace, out of it too. */
  current() {
    const found = this.newest();
    if (!found || this.captured - found.captured >= OLD_MS) return null;
    const tracks = carried(found, this.newest(found.frame - PACE_FRAMES), this.captured);
    const [wide, high] = this.size;
    return { ...found, tracks: tracks.filter(({ box: [x, y, right, low] }) => Math.max(0, x) < Math.min(wide, right) && Math.max(0, y) < Math.min(high, low)) };
  }

  /** The newest list of a picture or of one before it, however old; null where there is none. */
  newest(last = this.frame) {
    for (let frame = last; frame > last - LOOK_BACK && frame >= 0; frame--) {
      const found = this.overlays.get(frame);
      if (found) return found;
    }
    return null;
  }

  /** How far the picture that the boxes were seen in is behind this one, ms; null where there are none at all. */
  behind() {
    const found = this.newest();
    return found ? Math.max(0, this.captured - found.looked) : null;
  }

  /** @param {boolean} shown whether boxes are drawn at all */
  toggle(shown) {
    this.shown = shown;
    this.draw();
  }

  /** @param {string} name @param {boolean} drawn */
  filter(name, drawn) {
    if (drawn) this.left.delete(name);
    else this.left.add(name);
    this.draw();
  }

  /** Those that are drawn. */
  drawn() {
    if (!this.shown) return [];
    return (this.current()?.tracks ?? []).filter((track) => !this.left.has(track.name));
  }

  /** @param {string} name */
  colourOf(name) {
    return this.colours.get(name) ?? "#aab0b8";
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
    context.globalAlpha = list && this.captured - list.looked > FADED_MS ? 0.5 : 1;
    /** @type {number[][]} */
    const taken = [];
    const tracks = this.drawn();
    for (const track of tracks) this.drawBox(context, track, scale, ratio);
    // Those that a still has named go first, then the larger: where it is crowded the others go without.
    const named = tracks.filter((track) => !track.doubted).sort((one, other) => (other.read ?? 0) - (one.read ?? 0) || area(other.box) - area(one.box));
    const centres = named.map((track) => [((track.box[0] + track.box[2]) / 2) * scale, ((track.box[1] + track.box[3]) / 2) * scale]);
    named.forEach((track, index) => {
      this.drawName(context, track, scale, letter, taken, centres.filter((_, other) => other !== index), named.length > CROWD);
    });
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
    context.strokeStyle = this.colourOf(track.name);
    context.lineWidth = (track.read ? 3 : 1.5) * ratio;
    context.setLineDash(track.doubted ? [4 * ratio, 4 * ratio] : []);
    if (track.doubted) context.lineWidth = ratio;
    context.strokeRect(x, y, right - x, bottom - y);
    context.setLineDash([]);
  }

  /**
   * Name and score, above or below the box: where it covers another name, or the middle of another object, it is left
   * out. In a crowd an object smaller than its name has none.
   * @param {CanvasRenderingContext2D} context @param {Track} track @param {number} scale @param {number} letter
   * @param {number[][]} taken @param {number[][]} centres of the others @param {boolean} crowd
   */
  drawName(context, track, scale, letter, taken, centres, crowd) {
    const words = boxWords(track.name, track.sureness, Boolean(track.sure));
    const height = letter * 1.35;
    const width = context.measureText(words).width + letter * 0.5;
    const [x, y, end, low] = track.box.map((value) => value * scale);
    if (crowd && !track.read && end - x < width / 2) return;
    const left = Math.max(0, Math.min(x, this.canvas.width - width));
    for (const top of [y - height, low]) {
      const right = left + width;
      const bottom = top + height;
      if (top < 0 || bottom > this.canvas.height) continue;
      if (taken.some(([l, t, r, b]) => left < r && right > l && top < b && bottom > t)) continue;
      if (centres.some(([cx, cy]) => cx > left && cx < right && cy > top && cy < bottom)) continue;
      taken.push([left, top, right, bottom]);
      context.fillStyle = "#000a";
      context.fillRect(left, top, width, height);
      context.fillStyle = this.colourOf(track.name);
      context.fillText(words, left + letter * 0.25, top + letter);
      return;
    }
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
    const moved = Math.max(box[2] - box[0], box[3] - box[1]) * (this.canvas.clientWidth / this.size[0]);
    // A finger that moves scrolls, and one that rests does nothing: only a tap asks.
    if (event.pointerType !== "mouse" && (moved > TAP_PX || event.timeStamp - this.downAt > TAP_MS)) {
      this.draw();
      return;
    }
    const little = this.size[0] / 100;
    if (box[2] - box[0] > little && box[3] - box[1] > little) {
      this.onPick(box, null);
      return;
    }
    const [x, y] = this.place(event);
    const hit = this.drawn()
      .filter(({ box: [left, top, right, bottom] }) => x >= left && x <= right && y >= top && y <= bottom)
      .sort((one, other) => area(one.box) - area(other.box))[0];
    if (hit) this.onPick(hit.box, hit);
    else {
      const half = (this.size[0] * CLICK_SHARE) / 2;
      this.onPick([x - half, y - half, x + half, y + half], null);
    }
  }
}

/**
 * The tracks of a list where they would be later, by how far they have gone since a list before it; they keep their size.
 * @param {Overlay} list @param {Overlay | null} before @param {number} captured of the later picture, ms
 */
export function carried(list, before, captured) {
  if (!before || before.captured >= list.captured || captured <= list.captured) return list.tracks;
  const share = Math.min(2, (captured - list.captured) / (list.captured - before.captured));
  const boxes = new Map(before.tracks.map(({ id, box }) => [id, box]));
  return list.tracks.map((track) => {
    const was = boxes.get(track.id);
    if (!was) return track;
    const { box } = track;
    const moved = [0, 1].map((side) => {
      const [near, far] = [box[side] - was[side], box[side + 2] - was[side + 2]];
      return share * (near && far ? (near + far) / 2 : near + far); // one is cut off at the rim
    });
    return { ...track, box: box.map((value, side) => value + moved[side % 2]) };
  });
}

/** @param {number[]} box */
const area = (box) => (box[2] - box[0]) * (box[3] - box[1]);

/** @param {number[]} drag */
const sorted = ([x1, y1, x2, y2]) => [Math.min(x1, x2), Math.min(y1, y2), Math.max(x1, x2), Math.max(y1, y2)];
