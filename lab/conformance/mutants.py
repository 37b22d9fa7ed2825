"""``PYTHONPATH=. python -m lab.conformance.mutants``: break the TypeScript reader in many ways, one at a time.

Vectors are as good as the faults that they find: each mutant must fail one of them. One that makes no difference says
why.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lab.conformance.schema import PATH
from lab.conformance.vectors import FOLDER

READER = Path(__file__).with_name("reader.ts")
_DRIVER = Path(__file__).with_name("mutants.js")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One fault: a text of the compiled reader, which is there once, and what stands in its place."""

    what: str
    before: str
    after: str
    harmless: str = ""
    """Why no reader behaves otherwise; empty where a vector must notice."""


MUTANTS: tuple[Mutant, ...] = (
    # Envelope and MessagePack
    Mutant(
        "the checksum is not compared",
        "values[values.length - 1] === BigInt(crc32(",
        "values.length && BigInt(crc32(",
    ),
    Mutant(
        "the checksum covers no payload",
        "crc32(payload, data.subarray(0, -5))",
        "crc32(data.subarray(0, -5))",
    ),
    Mutant("the checksum may be coded in another way", "data[data.length - 5] === 0xce", "data.length > 5"),
    Mutant("a later version is read", "!SCHEMA.reads.includes(Number(version))", "version < SCHEMA.reads[0]"),
    Mutant("another version counts as damage", "`version ${version}`, true", "`version ${version}`"),
    Mutant(
        "the checksum is looked at before the version",
        "if (!SCHEMA.reads",
        "if (unpack(data).at(-1) === BigInt(crc32(payload, data.subarray(0, -5))) && !SCHEMA.reads",
    ),
    Mutant("all is read before the version", "unpack(data, 1)", "unpack(data)"),
    Mutant(
        "the length is looked at before the version",
        "const [version] =",
        'need(data.length <= SCHEMA.messages[name].most_bytes, "it is long");\n    const [version] =',
    ),
    Mutant("a sender may speak later versions alone", "fields[0] > version || ", ""),
    Mutant("a sender may speak earlier versions alone", " || fields[1] < version", ""),
    Mutant(
        "who speaks other versions is damaged",
        '"its sender speaks others", true',
        '"its sender speaks others"',
    ),
    Mutant("a message may be of any length", "data.length <= table.most_bytes", "data.length <= 1e9"),
    Mutant(
        "a message is a byte shorter at most",
        "data.length <= table.most_bytes",
        "data.length < table.most_bytes",
    ),
    Mutant(
        "a payload may be of any length", "payload.length <= table.payload_bytes", "payload.length <= 1e9"
    ),
    Mutant("bytes may follow", "if (at < data.length &&", "if (at < 0 &&"),
    Mutant("a key may come twice", " || found.has(key)", ""),
    Mutant("a key may be a number", 'typeof key !== "string" || ', ""),
    Mutant(
        "nesting has no bound",
        "const array = (length, depth) => {\n        if (depth > SCHEMA.limits.depth)",
        "const array = (length, depth) => {\n        if (depth > 400)",
    ),
    Mutant(
        "maps may be nested deeper",
        "const map = (length, depth) => {\n        if (depth > SCHEMA.limits.depth)",
        "const map = (length, depth) => {\n        if (depth > 400)",
    ),
    Mutant(
        "nesting ends a level too early",
        "const array = (length, depth) => {\n        if (depth > SCHEMA.limits.depth)",
        "const array = (length, depth) => {\n        if (depth >= SCHEMA.limits.depth)",
    ),
    *(
        Mutant(
            f"{what} may be nested deeper",
            f"return {of}(size({size}), depth + 1);",
            f"return {of}(size({size}), 0);",
        )
        for what, of, size in (
            ("arrays of 16 bits", "array", 2),
            ("arrays of 32 bits", "array", 4),
            ("maps of 16 bits", "map", 2),
            ("maps of 32 bits", "map", 4),
        )
    ),
    Mutant("a float of 32 bits is unknown", "case 0xca: return view.getFloat32(take(4));", ""),
    Mutant("a map of 16 bits is unknown", "case 0xde: return map(size(2), depth + 1);", ""),
    Mutant("an array of 32 bits is unknown", "case 0xdd: return array(size(4), depth + 1);", ""),
    *(
        Mutant(f"{what} is unknown", f"case 0x{tag}: return {code};", "")
        for what, tag, code in (
            ("a text of 16 bits", "da", "text(size(2))"),
            ("a text of 32 bits", "db", "text(size(4))"),
            ("an array of 16 bits", "dc", "array(size(2), depth + 1)"),
            ("a number of 8 bits", "cc", "BigInt(size(1))"),
            ("a number of 64 bits", "cf", "view.getBigUint64(take(8))"),
            ("bytes of 16 bits", "c5", "bytes(size(2))"),
            ("bytes of 32 bits", "c6", "bytes(size(4))"),
        )
    ),
    Mutant(
        "a number must be as short as may be",
        "return view.getBigUint64(take(8));",
        '{ const n = view.getBigUint64(take(8)); if (n < 2n ** 32n) throw new Refused("long"); return n; }',
    ),
    Mutant(
        "an unknown field may not be NaN",
        "return view.getFloat64(take(8));",
        '{ const n = view.getFloat64(take(8)); if (isNaN(n)) throw new Refused("NaN"); return n; }',
    ),
    Mutant("a signed byte has no sign", "view.getInt8(take(1))", "view.getUint8(take(1))"),
    Mutant("16 signed bits have no sign", "view.getInt16(take(2))", "view.getUint16(take(2))"),
    Mutant("32 signed bits have no sign", "view.getInt32(take(4))", "view.getUint32(take(4))"),
    Mutant("text is mended in place of refused", "fatal: true", "fatal: false"),
    Mutant("a mark of byte order is taken away", "ignoreBOM: true", "ignoreBOM: false"),
    # Types and bounds
    Mutant(
        "a whole number may be below its bound",
        "value >= low && value <= high, `no whole",
        "value <= high, `no whole",
    ),
    Mutant(
        "a whole number may be above its bound",
        "value >= low && value <= high, `no whole",
        "value >= low, `no whole",
    ),
    Mutant(
        "a fraction passes for a whole number",
        'typeof value === "bigint" && value >= low',
        'typeof value !== "string" && value >= low',
    ),
    Mutant(
        "true passes for a whole number",
        'typeof value === "bigint" && value >= low',
        '(typeof value === "bigint" || typeof value === "boolean") && value >= low',
    ),
    Mutant(
        "NaN passes for a fraction",
        "value >= low && value <= high, `no fraction",
        "!(value < low || value > high), `no fraction",
    ),
    Mutant(
        "a fraction may be below its bound",
        "value >= low && value <= high, `no fraction",
        "value <= high, `no fraction",
    ),
    Mutant(
        "a whole number passes for a fraction",
        'typeof value === "number" && value >= low',
        'typeof value !== "string" && value >= low',
    ),
    Mutant("a text is measured in characters", "utf8(value) <= most", "value.length <= most"),
    Mutant("a text may have controls", " && allowed(value)", ""),
    Mutant(
        "a text may change its direction",
        "one.codePointAt(0) < low ||",
        "one.codePointAt(0) < low || low > 0x2029 ||",
    ),
    Mutant(
        "a text may begin a line",
        "one.codePointAt(0) < low ||",
        "one.codePointAt(0) < low || low === 0x2028 ||",
    ),
    Mutant(
        "a text without marks alone is read",
        "one.codePointAt(0) < low ||",
        "(one.codePointAt(0) < low && one.codePointAt(0) < 0x2000) ||",
    ),
    Mutant(
        "bytes may be more",
        "value.length >= least && value.length <= most, `not",
        "value.length >= least, `not",
    ),
    Mutant(
        "bytes may be fewer",
        "value.length >= least && value.length <= most, `not",
        "value.length <= most, `not",
    ),
    Mutant(
        "1 passes for true",
        'typeof value === "boolean", "neither',
        'typeof value === "boolean" || value === 1n, "neither',
    ),
    Mutant(
        "an array may be longer",
        "value.length >= least && value.length <= most, `no array",
        "value.length >= least, `no array",
    ),
    Mutant(
        "an array may be shorter",
        "value.length >= least && value.length <= most, `no array",
        "value.length <= most, `no array",
    ),
    Mutant("a map may be longer", "value.size <= most", "value.size <= 1000"),
    Mutant("a key may be longer", "text(keys)(key);", ""),
    Mutant("a value of a map is not looked at", "        of(one);\n", ""),
    Mutant("a box may be inside out", "x1 <= x2 && y1 <= y2", "x1 <= x2"),
    Mutant("a box without an inside is refused", "x1 <= x2 && y1 <= y2", "x1 < x2 && y1 < y2"),
    Mutant(
        "a parameter may be infinite",
        "float(-most, most)(value);",
        '!Number.isNaN(value) || need(false, "");',
    ),
    Mutant("a parameter may be a long text", "text(bytes)(value);", "text(1000)(value);"),
    Mutant(
        "a parameter may be 2^63", "        whole(value);", '        need(typeof value === "bigint", "");'
    ),
    Mutant(
        "unknown fields are kept",
        "return fields.map(({ name, kind, missing }, place) => {",
        "if (values.length > fields.length)\n        return values;\n    "
        "return fields.map(({ name, kind, missing }, place) => {",
    ),
    Mutant(
        "unknown fields have no bound",
        "values.length <= fields.length + SCHEMA.limits.unknown_fields",
        "values.length < 1000",
    ),
    Mutant(
        "a field too few is read",
        "values.length >= least, `${values.length} fields, at",
        "values.length >= least - 1, `${values.length} fields, at",
    ),
    Mutant(
        "objects may have further fields",
        "value.length === fields.length, `no array of",
        "value.length >= fields.length, `no array of",
    ),
    Mutant(
        "stored frames may stand still",
        "row[0] > before[0] && row[1] > before[1]",
        "row[0] >= before[0] && row[1] > before[1]",
    ),
    Mutant(
        "stored times may stand still",
        "row[0] > before[0] && row[1] > before[1]",
        "row[0] > before[0] && row[1] >= before[1]",
    ),
    Mutant("a stored still need not say so", "& 8n) !== 0n", "& 8n) >= 0n"),
    Mutant("a stored still need not say when it was captured", '"capture_ns") >= 0n', '"capture_ns") >= -1n'),
    Mutant("stored video may be empty", "list(1, 2400,", "list(0, 2400,"),
    Mutant("stored video may be of any length", "list(1, 2400,", "list(1, 1e6,"),
    # Coded tracks
    Mutant("contexts learn for ever", "Math.min(30, context.n + 1)", "context.n + 1"),
    Mutant("contexts learn a step less", "Math.min(30, context.n + 1)", "Math.min(29, context.n + 1)"),
    Mutant("a step of any coding is read", "coding !== 1 || sequence", "sequence"),
    Mutant("a pose of any coding is read", '"coding") !== 1n', '"coding") < 1n'),
    Mutant("a number is a bit shorter at most", "need(length < 33,", "need(length < 32,"),
    Mutant("a half is rounded down", "old.vx * frames + 128", "old.vx * frames + 127"),
    Mutant("a little less than a half is rounded up", "old.vy * frames + 128", "old.vy * frames + 129"),
    Mutant("the median of none is not 0", ">> 1] : 0", ">> 1] : 1"),
    Mutant("a number may be of any length", "need(length < 33,", "need(length < 34,"),
    Mutant("bytes may be left over", "need(this.next >= this.data.length,", "need(true,"),
    Mutant("a step may end a byte early", "this.data.length < 4", "this.data.length < 5"),
    Mutant("a step may end early", "this.next - this.data.length < 4", "this.next - this.data.length < 400"),
    Mutant(
        "places have no bound", "held(-524272, 524272), held(1, 524272)", "held(-1e12, 1e12), held(1, 524272)"
    ),
    Mutant("sides may be zero", "held(1, 524272)", "held(0, 524272)"),
    Mutant("sides have no bound", "held(1, 524272)", "held(1, 1e12)"),
    Mutant("speed has no bound", "held(-(2 ** 24), 2 ** 24)", "held(-1e15, 1e15)"),
    Mutant("confidence has no bound", "held(0, 15)", "held(-100, 100)"),
    Mutant("shifts round to zero", "Math.floor(value / 2 ** places)", "Math.trunc(value / 2 ** places)"),
    Mutant("velocity rounds to zero", "fast(old.vx + Math.floor(", "fast(old.vx + Math.trunc("),
    Mutant("of two in the middle the upper counts", "[(values.length - 1) >> 1]", "[values.length >> 1]"),
    Mutant("missed tracks count for the median", "track.missed === 0);", "track.missed >= 0);"),
    Mutant("a class may be 2048", "found < SCHEMA.limits.classes", "found <= SCHEMA.limits.classes"),
    Mutant("tracks are forgotten a step early", "old.missed < 6", "old.missed < 5"),
    Mutant("tracks are forgotten a step late", "old.missed < 6", "old.missed < 7"),
    Mutant("missed tracks have no context of their own", "track.missed > 0 ? 1 : 0", "0"),
    Mutant(
        "the camera moves with nobody there",
        "any ? coder.signed(shared.x) * 4 : 0",
        "coder.signed(shared.x) * 4",
    ),
    Mutant("missed tracks are not held in place", "x: near(x), y: near(y), missed", "x, y, missed"),
    Mutant("there may be 1025 tracks", "births <= SCHEMA", "births - 1 <= SCHEMA"),
    Mutant("new tracks alone count for the most", "seen.length + births", "births"),
    Mutant("missed tracks count for the most", "seen.length + births", "found.length + births"),
    Mutant("an id may come twice", " && !known.has(id)", ""),
    Mutant("an id may be 2^32", "id <= 2 ** 32 - 1", "id <= 2 ** 32"),
    Mutant("a scale may be 12", "step <= 11", "step <= 12"),
    Mutant("a scale may be below 0", "step >= 0 && ", ""),
    Mutant(
        "the first velocity has no bound",
        "alone ? fast(coder.signed(shared.x) * 64)",
        "alone ? coder.signed(shared.x) * 64",
    ),
    Mutant(
        "a damaged step counts",
        'return "damaged";\n            throw error;\n        }\n        [this.sequence',
        "this.sequence = sequence;\n            else throw error;\n"
        '            return "damaged";\n        }\n        [this.sequence',
    ),
    Mutant(
        "a repetition that stands by itself is read",
        "sequence <= this.sequence ||",
        "(sequence <= this.sequence && reference !== -1) ||",
    ),
    Mutant(
        "a step's frame is looked at before its reference",
        "if (coding !== 1 ||",
        'if (frame <= this.frame && sequence > this.sequence) return "damaged";\n        if (coding !== 1 ||',
    ),
    Mutant("steps go on over sessions", 'of("session_id") !== this.session', "false"),
    Mutant("frames go on over sessions", '[of("session_id"), -1, -1]', '[of("session_id"), -1, this.frame]'),
    Mutant("a step may stand still", "need(frame > this.frame,", "need(frame >= this.frame,"),
    Mutant("a step is not sorted", "return found.sort((a, b) => a.id - b.id);", "return found;"),
    # Poses
    Mutant(
        "a number does not wrap below", "((((value - from) % span) + span) % span)", "((value - from) % span)"
    ),
    Mutant("a pose may have bits behind it", 'rest.length < 8 && !rest.includes("1")', "rest.length < 8"),
    Mutant(
        "a pose may have bytes behind it", 'rest.length < 8 && !rest.includes("1")', '!rest.includes("1")'
    ),
    Mutant("a pose's numbers have no bounds", "value >= kinds[index][0] && value <= kinds[index][1]", "true"),
    Mutant("a roll may be half a turn", "[-1800, 1799, 12, 3, true]", "[-1800, 1800, 12, 3, true]"),
    Mutant("a pose may have a byte behind it", "rest.length < 8", "rest.length < 9"),
    Mutant("a pose builds on one of long ago", " || sent - this.sent > 12e9", ""),
    Mutant("poses go on over sessions", "values[0] !== this.session", "false"),
    Mutant("a pose may go back in time", "time > this.time && ", ""),
    Mutant("a pose's number does not begin again at 16", "(this.number + 1) % 16", "this.number + 1"),
    # Where a still is
    Mutant("a word may be one beyond the list", "BigInt(high)", "BigInt(high + 1)"),
    Mutant("a word may be a text of any length", "text(most)(value);", "text(1e9)(value);"),
    Mutant(
        "a place may have nine numbers",
        "place.length === 8 || place.length === 10",
        "place.length >= 8 && place.length <= 10",
    ),
    Mutant("a crop may begin before the frame", "x >= 0 && y >= 0 && width > 0", "width > 0"),
    Mutant("a crop may be of no size", "width > 0 && height > 0 && ", ""),
    Mutant("a crop may end too far to the right", "x + width <= 32767 && ", ""),
    Mutant("a crop may end too far below", " && y + height <= 32767", ""),
    Mutant("a box may be inside out", " && box[0] <= box[2] && box[1] <= box[3]", ""),
    Mutant("a box may be upside down", " && box[1] <= box[3]", ""),
    Mutant("a box at its bound is refused", "Math.abs(side) <= 8", "Math.abs(side) < 8"),
    Mutant("a coded size of 1 is refused", "side >= 1 && side <= 32767", "side > 1 && side <= 32767"),
    Mutant("the largest coded size is refused", "side >= 1 && side <= 32767", "side >= 1 && side < 32767"),
    Mutant("any flag says that a still was stored", "& 8n) !== 0n", "& 255n) !== 0n"),
    Mutant("a stored still was never captured at 0", '"capture_ns") >= 0n', '"capture_ns") > 0n'),
    Mutant("stored video is more than a frame", "list(1, 2400,", "list(2, 2400,"),
    Mutant("stored video ends a frame early", "list(1, 2400,", "list(1, 2399,"),
    Mutant("a box has no bound", "Math.abs(side) <= 8 * 32767", "true"),
    Mutant("a coded size may be nothing", "side >= 1 && side <= 32767", "side <= 32767"),
    Mutant("a coded size has no bound", "side >= 1 && side <= 32767", "side >= 1"),
    Mutant("a field may be told as a parameter", '["w", "h", "b"].some(', "[].some("),
    # Backlog, and sizes of stills
    Mutant("a chunk beyond a gap is taken", "offset <= held && ", ""),
    Mutant("bytes that overlap are taken twice", "payload.subarray(held - offset)", "payload"),
    Mutant(
        "all is acknowledged before it is written", "[number, total - 1], object", "[number, total], object"
    ),
    Mutant("all is acknowledged while it is processed", "=== total ? total - 1 : 0", "=== total ? total : 0"),
    Mutant("another object of its name is busy too", "total - 1 : 0", "total - 1 : 1"),
    Mutant("the base that comes twice came last", "step.base > this.base", "step.base >= this.base"),
    Mutant("a chunk may be empty", "payload.length > 0 && offset", "offset"),
    Mutant(
        "a chunk may end beyond its object",
        "payload.length > 0 && offset + payload.length <= total",
        "payload.length > 0",
    ),
    Mutant("another total goes on", " || entry.total !== total", ""),
    Mutant("what was written is taken again", "if (this.done.get(key) === total)", "if (false)"),
    Mutant("what was written is of any size", "if (this.done.get(key) === total)", "if (this.done.has(key))"),
    Mutant("an unusable object counts", "usable ? total : 0", "total"),
    Mutant("objects are one", '["session_id", "kind", "number"].map', '["session_id", "kind"].map'),
    Mutant("objects have no session", '["session_id", "kind", "number"].map', '["kind", "number"].map'),
    Mutant("objects have no kind", '["session_id", "kind", "number"].map', '["session_id", "number"].map'),
    Mutant("a crop may end right of the source", "x + width <= source[0] && ", ""),
    Mutant("a crop may end below the source", " && y + height <= source[1]", ""),
    Mutant("a still may be wider than its crop", "w <= width && h <= height", "h <= height"),
    Mutant("a still may be higher than its crop", "w <= width && h <= height", "w <= width"),
    Mutant("a still may be of any width", "w <= most && h <= most", "h <= most"),
    Mutant("a still may be of any height", "w <= most && h <= most", "w <= most"),
    Mutant("who requested nothing gets any size", "? 2048 : 512", "? 2048 : 2048"),
    Mutant("a still may be of any shape", "<= Math.max(width, height)", "<= 1e9"),
    Mutant("the shape has a bound below the one", "<= Math.max(width, height)", "< Math.max(width, height)"),
    # Reports
    Mutant("who comes later misses all", "if (this.still >= 0 || this.fromStart)", ""),
    Mutant("who was there misses no first still", "this.still >= 0 || this.fromStart", "this.still >= 0"),
    Mutant("a still is missed a little longer", "at - since <= 6000", "at - since <= 6001"),
    Mutant("a still is missed a little shorter", "at - since <= 6000", "at - since < 6000"),
    Mutant("a stored still stays missing", "this.missing.delete(step.stored)", "undefined"),
    Mutant("a still that comes again stays missing", "this.missing.delete(step.still);", ""),
    Mutant("the oldest missing are named", "missing.slice(-32)", "missing.slice(0, 32)"),
    Mutant("all missing are named", "missing.slice(-32)", "missing"),
    Mutant("the last of the base counts", "step.base > this.base", "true"),
    Mutant("the last still counts", "Math.max(this.still, step.still)", "step.still"),
    Mutant("of two the lower delay counts", "5 * (low + high)", "10 * low"),
    Mutant("delays go on", "this.delays = [];\n        return", "return"),
    # Stills
    Mutant("the loop filter is off at QP 16", "qp > 15 ?", "qp > 16 ?"),
    Mutant("the loop filter is on at QP 15", "qp > 15 ?", "qp >= 15 ?"),
    Mutant("a QP may be 52", "qp <= 51", "qp <= 52"),
    Mutant("a sample may be 0", "Math.max(value, 1), 255)", "Math.max(value, 0), 255)"),
    Mutant("levels may be above", "held(0, 255)", "held(0, 1e9)"),
    Mutant("no byte follows zeros at the end", "    if (zeros)\n        out.push(3);\n", ""),
    Mutant("emulation is prevented for 3 alone", "byte <= 3", "byte < 3"),
    Mutant(
        "chroma below the picture is not that of its last row",
        "height: height / 2, at: all.slice(luma, luma",
        "height, at: all.slice(luma, luma",
    ),
    Mutant(
        "the picture is not filled up by its last column", "Math.min(x, width - 1)", "Math.min(x, width - 2)"
    ),
    Mutant("a half of a tap is rounded down", "(m + 1024)", "(m + 1023)"),
    Mutant("a little less than a half of a tap is rounded up", "(m + 1024)", "(m + 1025)"),
    Mutant("a little more than a sample is one", "Math.ceil(step / 65536)", "Math.ceil(step / 65537)"),
    Mutant("a still that shrinks by more than 32 is read", "need(n <= 32,", "need(n <= 1e6,"),
)


def built(folder: Path) -> Path:
    """The compiled reader; needs ``tsc``."""
    compiler = shutil.which("tsc")
    assert compiler is not None, "no TypeScript here (Debian: node-typescript)"
    settings = ["--target", "es2020", "--lib", "es2020", "--module", "commonjs", "--strict"]
    done = subprocess.run(
        [compiler, *settings, "--outDir", str(folder), str(READER)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stdout)
    return folder / "reader.js"


def survivors(reader: Path, mutants: Sequence[Mutant] = MUTANTS, *, vectors: Path = FOLDER) -> list[Mutant]:
    """Those of the mutants that pass all vectors; raises where the text of one is not there once."""
    text = reader.read_text(encoding="utf-8")
    for one in mutants:
        if text.count(one.before) != 1:
            raise ValueError(f"{one.what}: {one.before!r} is {text.count(one.before)} times in the reader")
    changes = [[one.before, one.after] for one in mutants]
    done = subprocess.run(
        ["node", str(_DRIVER), str(reader), str(PATH), str(vectors)],
        input=json.dumps(changes),
        capture_output=True,
        text=True,
        check=True,
    )
    return [mutants[number] for number in json.loads(done.stdout)]


def main() -> int:
    """Say which survive; 1 where one does that should not."""
    with tempfile.TemporaryDirectory() as folder:
        alive = survivors(built(Path(folder)))
    for one in alive:
        print(f"survives: {one.what}" + (f" (no difference: {one.harmless})" if one.harmless else ""))
    print(f"{len(MUTANTS) - len(alive)} of {len(MUTANTS)} mutants are caught")
    return 1 if any(not one.harmless for one in alive) else 0


if __name__ == "__main__":
    sys.exit(main())
