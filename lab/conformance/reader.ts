// A reader of the wire that knows docs/wire.md, wire-messages.md, wire-tracks.md and wire-stills.md and no line of the Python:
// it shows that they are enough, and that the code holds to them. It checks every vector of docs/conformance, and has the
// fields of messages and their bounds from docs/wire.json.
//
//   tsc --target es2020 --module commonjs --strict --outDir OUT lab/conformance/reader.ts
//   node OUT/reader.js docs/wire.json docs/conformance

declare function require(name: string): any;
declare const process: any;
const fs = require("fs");
const SCHEMA: any = JSON.parse(fs.readFileSync(process.argv[2], "utf-8"));

// What cannot be read. Another version is no damage: it is counted apart.
class Refused extends Error {
  constructor(reason: string, readonly version = false) {
    super(reason);
  }
}

// ---- Bytes ------------------------------------------------------------------------------------------------------

const CRC_TABLE = Array.from({ length: 256 }, (_, start) => {
  let value = start;
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? 0xedb88320 ^ (value >>> 1) : value >>> 1;
  return value >>> 0;
});

function crc32(...parts: Uint8Array[]): number {
  let crc = 0xffffffff;
  for (const part of parts) for (const byte of part) crc = CRC_TABLE[(crc ^ byte) & 0xff] ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}

const unhex = (text: string): Uint8Array => Uint8Array.from(text.match(/../g) ?? [], (pair) => parseInt(pair, 16));
// As vectors write them.
const bytesOf = (json: any): Uint8Array => (typeof json === "string" ? unhex(json) : new Uint8Array(json.zeros));
const hex = (bytes: Uint8Array): string => Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");

// ---- MessagePack ------------------------------------------------------------------------------------------------

// Whole numbers are bigint and fractions number, so that the two cannot be taken for one another.
type Value = null | boolean | bigint | number | string | Uint8Array | Value[] | Map<string, Value>;

// Of an array no more than its first values, where that is asked for.
function unpack(data: Uint8Array, first = Infinity): Value {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  let at = 0;
  const take = (length: number): number => {
    if (at + length > data.length) throw new Refused("it is cut short");
    at += length;
    return at - length;
  };
  const size = (bytes: 1 | 2 | 4): number => {
    const place = take(bytes);
    return bytes === 1 ? view.getUint8(place) : bytes === 2 ? view.getUint16(place) : view.getUint32(place);
  };
  const bytes = (length: number): Uint8Array => data.subarray(take(length), at);
  const text = (length: number): string => {
    try {
      return new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes(length));
    } catch (error) {
      throw error instanceof Refused ? error : new Refused("a text is not UTF-8");
    }
  };
  const array = (length: number, depth: number): Value[] => {
    if (depth > SCHEMA.limits.depth) throw new Refused("it is nested too deep");
    if (length > data.length) throw new Refused("an array is longer than the message");
    const values: Value[] = [];
    while (values.length < length && values.length < first) values.push(next(depth));
    return values;
  };
  const map = (length: number, depth: number): Map<string, Value> => {
    if (depth > SCHEMA.limits.depth) throw new Refused("it is nested too deep");
    const found = new Map<string, Value>();
    for (let entry = 0; entry < length; entry++) {
      const key = next(depth);
      if (typeof key !== "string" || found.has(key)) throw new Refused("a key is no text, or is there twice");
      found.set(key, next(depth));
    }
    return found;
  };
  const next = (depth: number): Value => {
    const tag = size(1);
    if (tag < 0x80) return BigInt(tag);
    if (tag < 0x90) return map(tag & 15, depth + 1);
    if (tag < 0xa0) return array(tag & 15, depth + 1);
    if (tag < 0xc0) return text(tag & 31);
    if (tag >= 0xe0) return BigInt(tag - 256);
    switch (tag) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xc4: return bytes(size(1));
      case 0xc5: return bytes(size(2));
      case 0xc6: return bytes(size(4));
      case 0xca: return view.getFloat32(take(4));
      case 0xcb: return view.getFloat64(take(8));
      case 0xcc: return BigInt(size(1));
      case 0xcd: return BigInt(size(2));
      case 0xce: return BigInt(size(4));
      case 0xcf: return view.getBigUint64(take(8));
      case 0xd0: return BigInt(view.getInt8(take(1)));
      case 0xd1: return BigInt(view.getInt16(take(2)));
      case 0xd2: return BigInt(view.getInt32(take(4)));
      case 0xd3: return view.getBigInt64(take(8));
      case 0xd9: return text(size(1));
      case 0xda: return text(size(2));
      case 0xdb: return text(size(4));
      case 0xdc: return array(size(2), depth + 1);
      case 0xdd: return array(size(4), depth + 1);
      case 0xde: return map(size(2), depth + 1);
      case 0xdf: return map(size(4), depth + 1);
      default: throw new Refused("a type that no message has");
    }
  };
  const value = next(0);
  if (at < data.length && first === Infinity) throw new Refused("bytes follow");
  return value;
}

// ---- The fields of docs/wire.json -------------------------------------------------------------------------------

// Throws Refused; gives the value without what is skipped in it, or nothing where it is as it came.
type Kind = (value: Value) => Value | void;
type Fields = { name: string; kind: Kind; missing?: Value }[];  // and the value where an earlier sender has none

const U53 = 2n ** 53n - 1n;
const utf8 = (text: string): number => new TextEncoder().encode(text).length;

function need(holds: boolean, reason: string): asserts holds {
  if (!holds) throw new Refused(reason);
}
const int = (low: bigint, high: bigint): Kind => (value) =>
  need(typeof value === "bigint" && value >= low && value <= high, `no whole number ${low}…${high}`);
const float = (low: number, high: number): Kind => (value) =>
  need(typeof value === "number" && value >= low && value <= high, `no fraction ${low}…${high}`);
const text = (most: number): Kind => (value) =>
  need(typeof value === "string" && utf8(value) <= most && allowed(value), `no text of ${most} bytes`);
const bin = (least: number, most: number): Kind => (value) =>
  need(value instanceof Uint8Array && value.length >= least && value.length <= most, `not ${least} to ${most} bytes`);
const bool: Kind = (value) => need(typeof value === "boolean", "neither true nor false");
const list = (least: number, most: number, of: Kind): Kind => (value) => {
  need(Array.isArray(value) && value.length >= least && value.length <= most, `no array of ${least} to ${most}`);
  return value.map((one) => of(one) ?? one);
};
const box = (of: Kind): Kind => (value) => {
  list(4, 4, of)(value);
  const [x1, y1, x2, y2] = value as bigint[];
  need(x1 <= x2 && y1 <= y2, "a box that is inside out");
};
const map = (most: number, keys: number, of: Kind): Kind => (value) => {
  need(value instanceof Map && value.size <= most, `no map of ${most}`);
  for (const [key, one] of value) {
    text(keys)(key);
    of(one);
  }
};
const scalar = (whole: Kind, most: number, bytes: number): Kind => (value) => {
  if (typeof value === "number") float(-most, most)(value);
  else if (typeof value === "string") text(bytes)(value);
  else whole(value);
};
// No control and no change of direction; a surrogate is no UTF-8.
const allowed = (value: string): boolean =>
  [...value].every((one) => SCHEMA.limits.refused_characters.every(([low, high]: number[]) => one.codePointAt(0)! < low || one.codePointAt(0)! > high));

function kindOf(row: any): Kind {
  switch (row.type) {
    case "int": return int(BigInt(row.low), BigInt(row.high));
    case "word": return listed(row.words.length - 1, row.most_bytes);
    case "listed": return listed(row.high, row.most_bytes);
    case "float": return float(row.low, row.high);
    case "bool": return bool;
    case "str": return text(row.most_bytes);
    case "bin": return bin(row.least_bytes, row.most_bytes);
    case "scalar": return scalar(int(BigInt(row.low), BigInt(row.high)), row.most, row.most_bytes);
    case "array": return row.box ? box(kindOf(row.of)) : list(row.least, row.most, kindOf(row.of));
    case "map": return map(row.most, row.key_bytes, kindOf(row.of));
    case "nested": return nested(fieldsOf(SCHEMA.nested[row.of]));
    default: throw new Error(`a type that this reader does not know: ${row.type}`);
  }
}
// As MessagePack would have it.
const valueOf = (json: any): Value => typeof json === "number" ? BigInt(json) : Array.isArray(json) ? json.map(valueOf) : json;
const fieldsOf = (table: any): Fields =>
  table.fields.map((row: any) => ({ name: row.name, kind: kindOf(row), missing: "default" in row ? valueOf(row.default) : undefined }));
// A word of a list by its number, or any other text.
const listed = (high: number, most: number): Kind => (value) => {
  if (typeof value === "string") text(most)(value);
  else int(0n, BigInt(high))(value);
};
const nested = (fields: Fields): Kind => (value) => {
  need(Array.isArray(value), "no nested array");
  return checkFields(fields, value);
};
// An array of an object of the backlog: these have no fields that came later.
const row = (fields: Fields): Kind => (value) => {
  need(Array.isArray(value) && value.length === fields.length, `no array of ${fields.length}`);
  return checkFields(fields, value);
};

// Skips what a later sender put behind the fields of the tables; the fields that an earlier one lacks have defaults.
function checkFields(fields: Fields, values: Value[]): Value[] {
  const least = fields.filter((one) => one.missing === undefined).length;
  need(values.length >= least, `${values.length} fields, at least ${least} are needed`);
  need(values.length <= fields.length + SCHEMA.limits.unknown_fields, `${values.length} fields, more than are skipped`);
  return fields.map(({ name, kind, missing }, place) => {
    if (place >= values.length) return missing!;
    try {
      return kind(values[place]) ?? values[place];
    } catch (error) {
      if (!(error instanceof Refused)) throw error;
      throw new Refused(`${name}: ${error.message}`);
    }
  });
}

function read(name: string, data: Uint8Array, payload: Uint8Array): Value[] {
  const table = SCHEMA.messages[name];
  const [version] = unpack(data, 1) as Value[];
  need(typeof version === "bigint", "no array that begins with a version");
  if (!SCHEMA.reads.includes(Number(version))) throw new Refused(`version ${version}`, true);
  need(data.length <= table.most_bytes, "it is too long");
  need(payload.length <= table.payload_bytes, "its payload is too long");
  const values = unpack(data) as Value[];
  need(data[data.length - 5] === 0xce, "no checksum at its end");
  need(values[values.length - 1] === BigInt(crc32(payload, data.subarray(0, -5))), "another checksum");
  const fields = checkFields(fieldsOf(table), values.slice(1, -1));
  if (table.fields[0].name === "lowest_version" && (fields[0]! > version || fields[1]! < version)) throw new Refused("its sender speaks others", true);
  if (name === "RoiHeader") {
    checkPlace((field(name, fields, "place") as bigint[]).map(Number));
    const parameters = field(name, fields, "parameters");
    need(!(parameters instanceof Map && ["w", "h", "b"].some((one) => parameters.has(one))), "a parameter that has a field");
  }
  return fields;
}

// Of the crop x, y, width and height, how far inside its sides those of the box are, and the coded size.
function checkPlace(place: number[]): void {
  need(place.length === 8 || place.length === 10, "a place of another length");
  const [x, y, width, height, left, top, right, bottom, ...coded] = place;
  need(x >= 0 && y >= 0 && width > 0 && height > 0 && x + width <= 32767 && y + height <= 32767, "no crop");
  const box = [8 * x + left, 8 * y + top, 8 * (x + width) - right, 8 * (y + height) - bottom];
  need(box.every((side) => Math.abs(side) <= 8 * 32767) && box[0] <= box[2] && box[1] <= box[3], "no box");
  need(coded.every((side) => side >= 1 && side <= 32767), "no coded size");
}

// The place of a field among the values of a message.
const field = (name: string, values: Value[], wanted: string): Value =>
  values[SCHEMA.messages[name].fields.findIndex((one: any) => one.name === wanted)];

// ---- Objects of the backlog -------------------------------------------------------------------------------------

function readObject(kind: string, data: Uint8Array): Value {
  need(data.length <= SCHEMA.limits.object_bytes, "it is too long");
  const values = unpack(data);
  if (kind === "still") {
    const [attachment, encoding, still] = row(fieldsOf(SCHEMA.objects.BacklogStill))(values) as [Uint8Array, string, Uint8Array];
    const header = read("RoiHeader", attachment, still);
    need((BigInt(field("RoiHeader", header, "flags") as bigint) & 8n) !== 0n, "it does not say that it was stored");
    need((field("RoiHeader", header, "capture_ns") as bigint) >= 0n, "it does not say when it was captured");
    return [attachment, encoding, still];
  }
  list(1, 2400, row(fieldsOf(SCHEMA.objects.BacklogUnit)))(values);
  let before: Value[] | undefined;
  for (const row of values as Value[][]) {
    need(!before || (row[0]! > before[0]! && row[1]! > before[1]!), "frames are not in order");
    before = row;
  }
  return values;
}

// ---- Coded tracks, wire-tracks.md -------------------------------------------------------------------------------

type Context = { zero: number; n: number };
const fresh = (): Context => ({ zero: 32768, n: 0 });
type Numbers = { nonzero: Context; sign: Context; length: Context[]; high: Context[] };
const freshNumbers = (): Numbers => ({
  nonzero: fresh(), sign: fresh(),
  length: Array.from({ length: 33 }, fresh), high: Array.from({ length: 33 }, fresh),
});

class RangeDecoder {
  private code = 0;
  private range = 0xffffffff;
  private next = 4;

  constructor(private readonly data: Uint8Array) {
    for (let place = 0; place < 4; place++) this.code = this.code * 256 + (data[place] ?? 0);
  }

  bit(context: Context): number {
    const bound = Math.floor(this.range / 65536) * context.zero;
    const one = this.code >= bound ? 1 : 0;
    if (one) {
      this.code -= bound;
      this.range -= bound;
      context.zero -= Math.floor(context.zero / (context.n + 2));
    } else {
      this.range = bound;
      context.zero += Math.floor((65536 - context.zero) / (context.n + 2));
    }
    context.n = Math.min(30, context.n + 1);
    this.normalise();
    return one;
  }

  plain(): number {
    this.range = Math.floor(this.range / 2);
    const one = this.code >= this.range ? 1 : 0;
    if (one) this.code -= this.range;
    this.normalise();
    return one;
  }

  unsigned(numbers: Numbers): number {
    let length = 0;
    while (this.bit(numbers.length[length])) {
      length += 1;
      need(length < 33, "a number that is too long");
    }
    if (length === 0) return 0;
    let value = 2 + this.bit(numbers.high[length]);
    for (let rest = length - 1; rest > 0; rest--) value = value * 2 + this.plain();
    return value - 1;
  }

  signed(numbers: Numbers): number {
    if (!this.bit(numbers.nonzero)) return 0;
    const negative = this.bit(numbers.sign);
    const size = this.unsigned(numbers) + 1;
    return negative ? -size : size;
  }

  finish(): void {
    need(this.next >= this.data.length, "bytes are left over");
  }

  private normalise(): void {
    while (this.range < 2 ** 24) {
      need(this.next - this.data.length < 4, "the step is cut short");
      this.code = (this.code * 256 + (this.data[this.next] ?? 0)) % 2 ** 32;
      this.range *= 256;
      this.next += 1;
    }
  }
}

type Track = {
  id: number; class: number; confidence: number; x: number; y: number; width: number; height: number;
  vx: number; vy: number; scale_x: number; scale_y: number; missed: number;
};

const held = (low: number, high: number) => (value: number): number => Math.min(Math.max(value, low), high);
const [near, sized, fast, sure] = [held(-524272, 524272), held(1, 524272), held(-(2 ** 24), 2 ** 24), held(0, 15)];
// Shifts on numbers that 32 bits may not hold.
const left = (value: number, places: number): number => value * 2 ** places;
const right = (value: number, places: number): number => Math.floor(value / 2 ** places);
const median = (values: number[]): number =>
  values.length ? [...values].sort((a, b) => a - b)[(values.length - 1) >> 1] : 0;

function readTracks(data: Uint8Array, before: Track[], frames: number, alone: boolean): Track[] {
  const coder = new RangeDecoder(data);
  const pair = () => ({ x: freshNumbers(), y: freshNumbers() });
  const [shared, move, grow, scale, side, place, drift] = [pair(), pair(), pair(), pair(), pair(), pair(), pair()];
  const [present, changed, classDiffers] = [[fresh(), fresh()], fresh(), fresh()];
  const [classes, confidences, count, ids] = [freshNumbers(), freshNumbers(), freshNumbers(), freshNumbers()];
  const readClass = (was: number): number => {
    if (!coder.bit(classDiffers)) return was;
    const found = coder.unsigned(classes);
    need(found < SCHEMA.limits.classes, "a class that cannot be");
    return found;
  };
  const found: Track[] = [];
  const listed = before.map((track) => coder.bit(present[track.missed > 0 ? 1 : 0]));
  const any = listed.some((there) => there);
  const sx = any ? coder.signed(shared.x) * 4 : 0;
  const sy = any ? coder.signed(shared.y) * 4 : 0;
  before.forEach((old, index) => {
    const track = { ...old };
    const x = old.x + right(old.vx * frames + 128, 8) + sx;
    const y = old.y + right(old.vy * frames + 128, 8) + sy;
    if (!listed[index]) {
      if (old.missed < 6) found.push({ ...track, x: near(x), y: near(y), missed: old.missed + 1 });
      return;
    }
    const dx = left(coder.signed(move.x), old.scale_x);
    const dy = left(coder.signed(move.y), old.scale_y);
    track.width = sized(old.width + left(coder.signed(grow.x), old.scale_x));
    track.height = sized(old.height + left(coder.signed(grow.y), old.scale_y));
    if (coder.bit(changed)) {
      track.class = readClass(old.class);
      track.confidence = sure(old.confidence + coder.signed(confidences));
    }
    track.x = near(x + dx);
    track.y = near(y + dy);
    track.vx = fast(old.vx + Math.floor(left(dx + sx, 7) / frames));
    track.vy = fast(old.vy + Math.floor(left(dy + sy, 7) / frames));
    track.missed = 0;
    found.push(track);
  });
  const seen = found.filter((track) => track.missed === 0);
  const cx = alone ? fast(coder.signed(shared.x) * 64) : median(seen.map((track) => track.vx));
  const cy = alone ? fast(coder.signed(shared.y) * 64) : median(seen.map((track) => track.vy));
  const known = new Set(found.map((track) => track.id));
  const births = coder.unsigned(count);
  need(seen.length + births <= SCHEMA.limits.tracks, "too many tracks");
  let p: Track = {
    id: 0, class: 0, confidence: 8, x: 0, y: 0, width: 640, height: 640, vx: 0, vy: 0, scale_x: 5, scale_y: 5, missed: 0,
  };
  const measure = (axis: "x" | "y", was: number, length: number): [number, number] => {
    const step = was + coder.signed(scale[axis]);
    need(step >= 0 && step <= 11, "a step that cannot be");
    return [step, sized(left(right(length, step) + coder.signed(side[axis]), step))];
  };
  for (let birth = 0; birth < births; birth++) {
    const id = p.id + 1 + coder.unsigned(ids);
    need(id <= 2 ** 32 - 1 && !known.has(id), "an id that cannot be");
    const kind = readClass(p.class);
    const confidence = sure(p.confidence + coder.signed(confidences));
    const [scale_x, width] = measure("x", p.scale_x, p.width);
    const [scale_y, height] = measure("y", p.scale_y, p.height);
    const x = near(left(coder.signed(place.x), scale_x));
    const y = near(left(coder.signed(place.y), scale_y));
    const vx = fast(cx + (alone ? left(coder.signed(drift.x), scale_x + 7) : 0));
    const vy = fast(cy + (alone ? left(coder.signed(drift.y), scale_y + 7) : 0));
    p = { id, class: kind, confidence, x, y, width, height, vx, vy, scale_x, scale_y, missed: 0 };
    found.push(p);
  }
  coder.finish();
  return found.sort((a, b) => a.id - b.id);
}

class TrackReader {
  tracks: Track[] = [];
  private session: Value = null; private sequence = -1; private frame = -1;

  // "read", "skipped" where it builds on a step that never came or is not newer, "damaged".
  take(data: Uint8Array): string {
    const values = read("TrackStep", data, new Uint8Array());
    const of = (name: string): Value => field("TrackStep", values, name);
    const [sequence, frame, reference, coding] = [of("sequence"), of("frame_index"), of("reference"), of("coding")].map(Number);
    if (of("session_id") !== this.session) [this.session, this.sequence, this.frame] = [of("session_id"), -1, -1];
    if (coding !== 1 || sequence <= this.sequence || (reference !== -1 && reference !== this.sequence)) return "skipped";
    try {
      need(frame > this.frame, "it does not lie ahead");
      const before = reference === -1 ? [] : this.tracks;
      this.tracks = readTracks(of("boxes") as Uint8Array, before, frame - this.frame, reference === -1);
    } catch (error) {
      if (error instanceof Refused) return "damaged";
      throw error;
    }
    [this.sequence, this.frame] = [sequence, frame];
    return "read";
  }
}

// ---- Poses, wire-messages.md ------------------------------------------------------------------------------------

class Bits {
  private readonly bits: string;
  private next = 0;

  constructor(bytes: Uint8Array) {
    this.bits = Array.from(bytes, (one) => one.toString(2).padStart(8, "0")).join("");
  }

  plain(count: number): number {
    need(this.next + count <= this.bits.length, "it ends too early");
    this.next += count;
    return count ? parseInt(this.bits.slice(this.next - count, this.next), 2) : 0;
  }

  // An Exp-Golomb code of order k.
  change(k: number): number {
    let zeros = 0;
    while (!this.plain(1)) need(++zeros <= 40, "too many zeros");
    const m = 2 ** (zeros + k) + this.plain(zeros + k) - 2 ** k;
    return m % 2 ? (m + 1) / 2 : -m / 2;
  }

  finish(): void {
    const rest = this.bits.slice(this.next);
    need(rest.length < 8 && !rest.includes("1"), "something is left");
  }
}

// From, to, bits, k, and whether it wraps.
type Numbered = [number, number, number, number, boolean];
const ANGLES: Numbered[] = [[0, 3599, 12, 3, true], [-900, 900, 11, 3, false], [-1800, 1799, 12, 3, true]];
const METRES: Numbered[] = [[-1e4, 1e6, 20, 2, false]];
const POSE: [string, Numbered[]][] = [
  ["place", [[-9e8, 9e8, 31, 5, false], [-1.8e9, 1.8e9 - 1, 32, 5, true]]], ["height", METRES], ["altitude", METRES],
  ["camera", ANGLES], ["platform", ANGLES], ["field", [[1, 1799, 11, 0, false]]],
  ["errors", Array(3).fill([0, 31, 5, 0, false])],
];
const wrapped = (value: number, [from, to]: Numbered): number => {
  const span = to - from + 1;
  return ((((value - from) % span) + span) % span) + from;
};

class PoseReader {
  private session: Value = null; private number = -1; private time = 0; private sent = 0;
  private step = [0, 0];
  private groups: Record<string, number[] | null> | undefined;

  // The numbers of a report as the vectors write them, "skipped" or "damaged".
  take(data: Uint8Array): unknown {
    try {
      const values = read("PoseReport", data, new Uint8Array());
      if (values[0] !== this.session) [this.session, this.groups] = [values[0], undefined];
      if (field("PoseReport", values, "coding") !== 1n) return "skipped";
      return this.decode(new Bits(field("PoseReport", values, "coded") as Uint8Array), Number(values[1]));
    } catch (error) {
      if (error instanceof Refused) return "damaged";
      throw error;
    }
  }

  private decode(bits: Bits, sent: number): unknown {
    const [alone, number] = [bits.plain(1), bits.plain(4)];
    const before = this.groups;
    if (!alone && (!before || number !== (this.number + 1) % 16 || sent - this.sent > 12e9)) return "skipped";
    const time = alone ? bits.plain(42) : this.time + 1000 + bits.change(4);
    need(alone === 1 || (time > this.time && time < 2 ** 42), "no time behind the last");
    const there = alone ? Array.from({ length: 5 }, () => bits.plain(1)) : [];
    const step = [0, 0];
    const groups: Record<string, number[] | null> = {};
    POSE.forEach(([name, kinds], place) => {
      const known = alone ? place === 0 || place > 5 || there[place - 1] : before![name];
      groups[name] = known
        ? kinds.map((kind, index) => {
            if (alone) return kind[0] + bits.plain(kind[2]);
            let change = bits.change(kind[3]);
            if (name === "place") change = step[index] = this.step[index] + change;
            const value = before![name]![index] + change;
            return kind[4] ? wrapped(value, kind) : value;
          })
        : null;
      groups[name]?.forEach((value, index) => need(value >= kinds[index][0] && value <= kinds[index][1], "out of bounds"));
    });
    bits.finish();
    [this.number, this.sent, this.time, this.step, this.groups] = [number, sent, time, step, groups];
    const one = (name: string): number | null => (groups[name] ? groups[name]![0] : null);
    return { ...groups, time_ms: time, height: one("height"), altitude: one("altitude"), field: one("field") };
  }
}

// ---- Stills, wire-stills.md -------------------------------------------------------------------------------------

type Plane = { width: number; height: number; at: ArrayLike<number> };
const floor = Math.floor;
const levels = held(0, 255);
const filled = (side: number): number => 16 * Math.ceil(side / 16);

// Y, Cb and Cr of a picture whose planes follow each other.
function planesOf(bytes: ArrayLike<number>, width: number, height: number): Plane[] {
  const all = Array.from(bytes);
  const [luma, chroma] = [width * height, (width / 2) * (height / 2)];
  return [
    { width, height, at: all.slice(0, luma) },
    { width: width / 2, height: height / 2, at: all.slice(luma, luma + chroma) },
    { width: width / 2, height: height / 2, at: all.slice(luma + chroma) },
  ];
}

// The planes of a crop of BGR pixels, filled up to whole blocks.
function coded(bgr: Uint8Array, width: number, height: number): Uint8Array {
  const [wide, high] = [filled(width), filled(height)];
  const pixel = (x: number, y: number): number[] => {
    const place = 3 * (Math.min(y, height - 1) * width + Math.min(x, width - 1));
    return [bgr[place + 2], bgr[place + 1], bgr[place]];
  };
  const out: number[] = [];
  const sample = (value: number): number => out.push(Math.min(Math.max(value, 1), 255));
  for (let y = 0; y < high; y++)
    for (let x = 0; x < wide; x++) {
      const [r, g, b] = pixel(x, y);
      sample(floor((19595 * r + 38470 * g + 7471 * b + 32768) / 65536));
    }
  for (const [cr, cg, cb] of [[-11059, -21709, 32768], [32768, -27439, -5329]])
    for (let y = 0; y < high; y += 2)
      for (let x = 0; x < wide; x += 2) {
        let sum = 0;
        for (const [dx, dy] of [[0, 0], [1, 0], [0, 1], [1, 1]]) {
          const [r, g, b] = pixel(x + dx, y + dy);
          sum += cr * r + cg * g + cb * b;
        }
        sample(floor((sum + 131072) / 262144) + 128);
      }
  return Uint8Array.from(out);
}

// 16 times as large, in twice its width and height.
function enlarged(plane: Plane): Plane {
  const value = (x: number, y: number): number =>
    plane.at[Math.min(Math.max(y, 0), plane.height - 1) * plane.width + Math.min(Math.max(x, 0), plane.width - 1)];
  const [width, height] = [2 * plane.width, 2 * plane.height];
  const at = Array.from({ length: width * height }, (_, place) => {
    const [x, y] = [place % width, floor(place / width)];
    const [cx, cy] = [x >> 1, y >> 1];
    const [nx, ny] = [x % 2 ? cx + 1 : cx - 1, y % 2 ? cy + 1 : cy - 1];
    return 9 * value(cx, cy) + 3 * value(nx, cy) + 3 * value(cx, ny) + value(nx, ny);
  });
  return { width, height, at };
}

// B, G and R of planes whose chroma is around zero, cut to a size, and not held.
function colours([luma, first, second]: Plane[], width: number, height: number): number[] {
  const [cb, cr] = [enlarged(first), enlarged(second)];
  const out: number[] = [];
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++) {
      const place = y * luma.width + x;
      const [l, b, r] = [1048576 * luma.at[place] + 524288, cb.at[place], cr.at[place]];
      out.push(floor((l + 116130 * b) / 1048576), floor((l - 22554 * b - 46802 * r) / 1048576), floor((l + 91881 * r) / 1048576));
    }
  return out;
}

const shifted = (plane: Plane, by: (place: number) => number): Plane =>
  ({ ...plane, at: Array.from(plane.at, (value, place) => value - by(place)) });

// What each pixel of an axis takes of which samples, and of how many.
function axis(origin: number, step: number, count: number, length: number): { taps: [number, number][][]; n: number } {
  const n = Math.max(1, Math.ceil(step / 65536));
  need(n <= 32, "a still that shrinks too much");
  const taps = Array.from({ length: count }, (_, i) => {
    const found: [number, number][] = [];
    for (let j = i * n; j < (i + 1) * n; j++) {
      const m = origin + floor(((2 * j + 1) * step) / (2 * n)) - 32768;
      const q = floor((m + 1024) / 2048);
      const k = floor(q / 32);
      const f = q - 32 * k;
      const weights = [
        -3 * (f ** 3 - 64 * f ** 2 + 1024 * f), 5 * f ** 3 - 288 * f ** 2 + 131072,
        -5 * f ** 3 + 192 * f ** 2 + 3072 * f, 3 * f ** 3 - 96 * f ** 2,
      ];
      weights.forEach((weight, tap) => found.push([Math.min(Math.max(k - 1 + tap, 0), length - 1), weight]));
    }
    return found;
  });
  return { taps, n };
}

function baseCrop(vector: any): Uint8Array {
  const [[w, h], [x1, y1, x2, y2], scale] = [vector.size, vector.crop_source_px, vector.view_scale];
  const fixed = (value: number): number => floor(value * 65536 + 0.5);
  const across = [fixed(x1 * scale + vector.view_offset_px[0]), fixed(((x2 - x1) / w) * scale)];
  const down = [fixed(y1 * scale + vector.view_offset_px[1]), fixed(((y2 - y1) / h) * scale)];
  const [y, cb, cr] = vector.base_planes.map((text: string, index: number) => {
    const [part, at] = [index ? 2 : 1, unhex(text)];
    const [width, height] = vector.base_size.map((side: number) => Math.ceil(side / part));
    const rows = axis(floor(down[0] / part), floor(down[1] / part), h, height);
    const columns = axis(floor(across[0] / part), floor(across[1] / part), w, width);
    const total = rows.n * columns.n * 2 ** 28;
    return rows.taps.flatMap((row) =>
      columns.taps.map((column) => {
        let sum = 0;
        for (const [top, weight] of row) for (const [left, other] of column) sum += weight * other * at[top * width + left];
        return Math.min(Math.max(floor((sum + total / 2) / total), 0), 16320);
      }),
    );
  });
  return Uint8Array.from(
    y.flatMap((level: number, place: number) => {
      const [e, b, r] = [76309 * (level - 1024) + 2097152, cb[place] - 8192, cr[place] - 8192];
      return [e + 138438 * b, e - 13975 * b - 34925 * r, e + 117489 * r].map((sum) => levels(floor(sum / 4194304)));
    }),
  );
}

// Bits as text, most significant first.
const ue = (value: number): string => "0".repeat((value + 1).toString(2).length - 1) + (value + 1).toString(2);
const se = (value: number): string => ue(value > 0 ? 2 * value - 1 : -2 * value);
const packed = (bits: string, fill: string): number[] =>
  (bits + fill.repeat((8 - (bits.length % 8)) % 8)).match(/.{8}/g)!.map((byte) => parseInt(byte, 2));

// A NAL unit behind its start code, with emulation prevention bytes.
function unit(first: number, body: number[]): number[] {
  const out = [0, 0, 0, 1, first];
  let zeros = 0;
  for (const byte of body) {
    if (zeros >= 2 && byte <= 3) {
      out.push(3);
      zeros = 0;
    }
    out.push(byte);
    zeros = byte ? 0 : zeros + 1;
  }
  if (zeros) out.push(3);
  return out;
}

function stream(payload: Uint8Array, width: number, height: number, reference?: Uint8Array): Uint8Array {
  const [w, h, qp] = [filled(width) / 16, filled(height) / 16, payload[0]];
  need(payload.length > 1 && qp <= 51, "no coded slice");
  const picture = (set: number, cabac: string): number[] =>
    unit(0x68, packed(`${ue(set)}${ue(0)}${cabac}0${ue(0).repeat(3)}000${se(0)}${se(0)}${se(4)}10010${se(4)}1`, "0"));
  const sets = unit(0x67, [
    ...[100, 0, 62],
    ...packed(`${ue(0)}${ue(1)}${ue(0)}${ue(0)}00${ue(0)}${ue(2)}${ue(1)}0${ue(w - 1)}${ue(h - 1)}11001`, "0"),
  ]).concat(picture(0, "1"), picture(1, "0"));
  const deblocking = qp > 15 ? ue(0) + se(0) + se(0) : ue(1);
  const data = Array.from(payload.subarray(1));
  if (!reference) {
    const header = `${ue(0)}${ue(7)}${ue(0)}0000${ue(0)}00${se(qp - 26)}${deblocking}`;
    return Uint8Array.from(sets.concat(unit(0x65, packed(header, "1").concat(data))));
  }
  const planes = planesOf(reference, 16 * w, 16 * h);
  const blocks: number[] = [];
  let bits = `${ue(0)}${ue(7)}${ue(1)}0000${ue(0)}00${se(0)}${ue(1)}`;
  for (let y = 0; y < h; y++)
    for (let x = 0; x < w; x++) {
      blocks.push(...packed(bits + ue(25), "0"));
      bits = "";
      planes.forEach((plane, index) => {
        const side = index ? 8 : 16;
        for (let row = 0; row < side; row++)
          for (let column = 0; column < side; column++) blocks.push(plane.at[(y * side + row) * plane.width + x * side + column]);
      });
    }
  const header = `${ue(0)}${ue(5)}${ue(0)}000100${ue(0)}${se(qp - 26)}${deblocking}`;
  return Uint8Array.from(sets.concat(unit(0x65, blocks.concat(0x80)), unit(0x01, packed(header, "1").concat(data))));
}

// Whether a residual builds on this reference picture: of the CRC the low 16 bits count.
function builds(reference: Uint8Array, vector: any): boolean {
  return (crc32(reference) & 0xffff) === (vector.parameters.b & 0xffff);
}

// This reader has no decoder of H.264: it takes the decoded picture from the vector, and checks all around it.
function checkStill(vector: any): string | undefined {
  const [payload, [width, height]] = [unhex(vector.payload), vector.size];
  const picture = (bytes: Uint8Array): Plane[] => planesOf(bytes, filled(width), filled(height));
  const differs = (what: string, found: ArrayLike<number>): string | undefined =>
    hex(Uint8Array.from(found)) === vector[what] ? undefined : `another ${what}`;
  if (vector.codec === "h264-intra") {
    const planes = picture(unhex(vector.decoded)).map((plane, index) => shifted(plane, () => (index ? 128 : 0)));
    return differs("stream", stream(payload, width, height)) ?? differs("pixels", colours(planes, width, height).map(levels));
  }
  if (vector.codec !== "residual") return vector.tolerance && payload.length ? undefined : "no picture file";
  const base = baseCrop(vector);
  const reference = coded(base, width, height);
  if (!builds(reference, vector)) return "another base";
  const [before, after] = [picture(reference), picture(unhex(vector.decoded))];
  const change = colours(after.map((plane, index) => shifted(plane, (place) => before[index].at[place])), width, height);
  return (
    differs("base_crop", base) ?? differs("reference", reference) ?? differs("stream", stream(payload, width, height, reference)) ??
    differs("pixels", Array.from(base, (value, place) => levels(value + change[place])))
  );
}

// Width and height at which a still was coded.
function codedSize(header: Value[], source: number[]): number[] {
  const [x, y, width, height, , , , , ...coded] = (field("RoiHeader", header, "place") as bigint[]).map(Number);
  const [w, h] = coded.length ? coded : [width, height];
  need(x + width <= source[0] && y + height <= source[1], "a crop beyond the source");
  need(w <= width && h <= height, "larger than its crop");
  const parameters = field("RoiHeader", header, "parameters");
  const most = parameters instanceof Map && parameters.has("ask") ? 2048 : 512;
  need(w <= most && h <= most, "larger than such a still");
  need(Math.abs(w * height - h * width) <= Math.max(width, height), "of another shape");
  return [w, h];
}

// What becomes of a still before a decoder sees it: refused, not shown for want of its base, or the stream that it gets.
function checkStillCase(vector: any): string | undefined {
  const refused = refusal(() => {
    if (vector.header) {
      const size = codedSize(read("RoiHeader", unhex(vector.header), new TextEncoder().encode("a still")), vector.source_size);
      if (vector.size && canonical(size) !== canonical(vector.size)) throw new Refused(`another size: ${size}`);
      return;
    }
    if (vector.base_planes) {
      if (!builds(coded(baseCrop(vector), vector.size[0], vector.size[1]), vector)) throw new Refused("again");
      return;
    }
    const found = hex(stream(unhex(vector.payload), vector.size[0], vector.size[1]));
    if (vector.stream !== undefined && found !== vector.stream) throw new Refused(`another stream: ${found}`);
  });
  const became = refused === undefined ? "read" : refused.message === "again" ? "again" : "refused";
  return became === vector.becomes ? undefined : `it is ${became}: ${refused?.message}`;
}

// ---- Backlog ----------------------------------------------------------------------------------------------------

class BacklogReader {
  private open = new Map<string, { total: number; data: Uint8Array }>();
  private done = new Map<string, number>();
  private busy: [string, number, number] | undefined;  // the complete object that is not settled: key, number, total

  // What the next report says of the object, and the object where this chunk completes it.
  take(data: Uint8Array, payload: Uint8Array): { acknowledged: number[]; object?: string } {
    const header = read("BacklogHeader", data, payload);
    const of = (name: string): number => Number(field("BacklogHeader", header, name));
    const [number, offset, total] = [of("number"), of("offset"), of("total_bytes")];
    const key = ["session_id", "kind", "number"].map((name) => field("BacklogHeader", header, name)).join();
    need(payload.length > 0 && offset + payload.length <= total, "a chunk that is none");
    if (this.done.get(key) === total) return { acknowledged: [number, total] };
    if (this.busy?.[0] === key) return { acknowledged: [number, this.busy[2] === total ? total - 1 : 0] };
    let entry = this.open.get(key);
    if (entry === undefined || entry.total !== total) entry = { total, data: new Uint8Array() };
    const held = entry.data.length;
    if (offset <= held && offset + payload.length > held)
      entry.data = Uint8Array.from([...entry.data, ...payload.subarray(held - offset)]);
    this.open.set(key, entry);
    if (entry.data.length < total) return { acknowledged: [number, entry.data.length] };
    this.open.delete(key);
    this.busy = [key, number, total];
    return { acknowledged: [number, total - 1], object: hex(entry.data) };
  }

  settle(usable: boolean): { acknowledged: number[] } {
    const [key, number, total] = this.busy!;
    this.busy = undefined;
    if (usable) this.done.set(key, total);
    return { acknowledged: [number, usable ? total : 0] };
  }
}

// ---- The order of the base stream -------------------------------------------------------------------------------

class Order {
  private session: Value = null; private next = 0; private waits = true;
  private ended = new Set<Value>();

  // Whether a decoder gets it.
  take(data: Uint8Array, payload: Uint8Array): boolean {
    if (refusal(() => read("BaseHeader", data, payload))) return false;
    const values = read("BaseHeader", data, payload);
    const [session, sequence, , , , flags] = values as bigint[];
    if (this.ended.has(session)) return false;
    if (session !== this.session) [this.session, this.next, this.waits] = [this.ended.add(this.session) && session, 0, true];
    if (sequence < this.next) return false;
    this.waits = (flags & 1n) === 0n && (this.waits || sequence > this.next);
    this.next = Number(sequence) + 1;
    return !this.waits;
  }
}

// ---- Reports ----------------------------------------------------------------------------------------------------

class Report {
  private base = -1;
  private still = -1;
  private came = 0;
  private fromStart = false;
  private missing = new Map<number, number>();  // number, and when it was first missed
  private delays: number[] = [];

  take(step: any): object | undefined {
    if (step.report_at_ms !== undefined) return this.report(step.report_at_ms);
    if (step.base !== undefined) {
      this.fromStart ||= step.base === 0;
      if (step.base > this.base) [this.base, this.came] = [step.base, step.at_ms];
      if (step.delay_ms !== undefined) this.delays.push(step.delay_ms);
    } else if (step.stored !== undefined) this.missing.delete(step.stored);
    else {
      this.missing.delete(step.still);
      if (this.still >= 0 || this.fromStart)
        for (let number = this.still + 1; number < step.still; number++) this.missing.set(number, step.at_ms);
      this.still = Math.max(this.still, step.still);
    }
    return undefined;
  }

  private report(at: number): object {
    const missing = [...this.missing].filter(([, since]) => at - since <= 6000).map(([number]) => number);
    const sorted = this.delays.sort((a, b) => a - b);
    const [low, high] = [sorted[(sorted.length - 1) >> 1], sorted[sorted.length >> 1]];
    this.delays = [];
    return {
      report_at_ms: at, base_sequence: this.base, base_held_us: this.base < 0 ? 0 : (at - this.came) * 1000,
      still_sequence: this.still, missing_stills: missing.slice(-32), delay_p50_ms: low === undefined ? -10 : Math.round(5 * (low + high)),
    };
  }
}

// ---- The vectors ------------------------------------------------------------------------------------------------

// As the vectors write it: whole numbers beyond 2^53 as text, bytes as {"hex": …}.
function plain(value: Value): unknown {
  if (typeof value === "bigint") return value <= U53 && value >= -U53 ? Number(value) : String(value);
  if (value instanceof Uint8Array) return { hex: hex(value) };
  if (value instanceof Map) return Object.fromEntries([...value].map(([key, one]) => [key, plain(one)]));
  return Array.isArray(value) ? value.map(plain) : value;
}

// Keys in one order, so that two objects compare as texts.
const canonical = (value: any): string =>
  JSON.stringify(value, (_key, one) =>
    one && typeof one === "object" && !Array.isArray(one) ? Object.fromEntries(Object.entries(one).sort()) : one,
  );

function refusal(attempt: () => unknown): Refused | undefined {
  try {
    attempt();
  } catch (error) {
    if (error instanceof Refused) return error;
    throw error;
  }
  return undefined;
}

// Each gives what is wrong with a vector, nothing where it holds.
const CHECKS: Record<string, (vector: any) => string | undefined> = {
  "messages.json": (vector) => {
    const values = read(vector.message, unhex(vector.hex), bytesOf(vector.payload));
    return canonical(values.map(plain)) === canonical(vector.fields) ? undefined : canonical(values.map(plain));
  },
  "refused.json": (vector) => {
    const refused = refusal(() => read(vector.message, unhex(vector.hex), bytesOf(vector.payload)));
    if (!refused) return "it was read";
    return refused.version === vector.version ? undefined : `it was refused for: ${refused.message}`;
  },
  "objects.json": (vector) => {
    const refused = refusal(() => readObject(vector.kind, unhex(vector.hex)));
    if (refused) return vector.values ? refused.message : undefined;
    const values = canonical(plain(readObject(vector.kind, unhex(vector.hex))));
    return values === canonical(vector.values) ? undefined : values;
  },
  "track-steps.json": (vector) => {
    const reader = new TrackReader();
    for (const [number, step] of vector.steps.entries()) {
      const became = reader.take(unhex(step.hex));
      const expected = step.damaged ? "damaged" : step.skipped ? "skipped" : "read";
      if (became !== expected) return `step ${number} is ${became}, not ${expected}`;
      if (step.count !== undefined && step.count !== reader.tracks.length) return `step ${number}: another number of tracks`;
      if (step.tracks && canonical(reader.tracks) !== canonical(step.tracks)) return `step ${number}: another list`;
    }
    return undefined;
  },
  "poses.json": (vector) => {
    const reader = new PoseReader();
    for (const [number, report] of vector.reports.entries()) {
      const became = reader.take(unhex(report.hex));
      const expected = report.damaged ? "damaged" : report.skipped ? "skipped" : report.pose;
      if (canonical(became) !== canonical(expected)) return `report ${number} is ${canonical(became)}`;
    }
    return undefined;
  },
  "backlog-dialogues.json": (vector) => {
    const reader = new BacklogReader();
    for (const [number, step] of vector.steps.entries()) {
      const { hex: data, payload, usable, refused, ...expected } = step;
      let became: object | undefined;
      const why = refusal(() => (became = data === undefined ? reader.settle(usable) : reader.take(unhex(data), unhex(payload))));
      if (!!why !== !!refused || (!why && canonical(became) !== canonical(expected))) return `step ${number}: ${canonical(became)}`;
    }
    return undefined;
  },
  "base-orders.json": (vector) => {
    const reader = new Order();
    for (const [number, step] of vector.steps.entries())
      if (reader.take(unhex(step.hex), unhex(step.payload)) !== step.decode) return `step ${number}: not ${step.decode}`;
    return undefined;
  },
  "report-traces.json": (vector) => {
    const reader = new Report();
    for (const [number, step] of vector.steps.entries()) {
      const report = reader.take(step);
      if (report && canonical(report) !== canonical(step)) return `step ${number}: ${canonical(report)}`;
    }
    return undefined;
  },
  "stills.json": checkStill,
  "still-cases.json": checkStillCase,
};

function main(folder: string): number {
  let failed = 0;
  for (const [file, check] of Object.entries(CHECKS)) {
    const vectors: any[] = JSON.parse(fs.readFileSync(`${folder}/${file}`, "utf-8"));
    let good = 0;
    vectors.forEach((vector, index) => {
      let wrong: string | undefined;
      try {
        wrong = check(vector);
      } catch (error) {
        wrong = String(error);
      }
      if (wrong === undefined) good += 1;
      else console.log(`${file} ${index}: ${vector.message ?? vector.kind ?? vector.session ?? vector.codec}, ${vector.what ?? ""}: ${wrong}`);
    });
    console.log(`${file}: ${good} of ${vectors.length}`);
    failed += vectors.length - good;
  }
  return failed ? 1 : 0;
}

declare const console: any;
declare class TextDecoder {
  constructor(name: string, options: object);
  decode(bytes: Uint8Array): string;
}
declare class TextEncoder {
  encode(text: string): Uint8Array;
}

process.exit(main(process.argv[3]));
