"""Mutations that get past the checksum: of raw bytes, of the values in a message, and of parts of an input.

`Bytes` is whatever mutates plain bytes: libFuzzer's own mutator where atheris drives, `plain` in the short tests.
"""

import zlib
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import msgpack

Bytes = Callable[[bytes], bytes]
Mutator = Callable[[bytes, Random, Bytes], bytes]
"""(input, dice, mutator of plain bytes) → input."""

_CRC_BYTES = 5
_MOST_PARTS = 8
_NUMBERS = (-(2**63), -(2**31), -32768, -1, 0, 1, 2, 15, 16, 63, 255, 256, 2047, 2048, 32767, 65536)
_LARGE = (2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
_REALS = (0.0, -0.0, 0.5, -1.0, 1e-310, 1e300, 1.8e308, float("inf"), float("-inf"), float("nan"))
_TEXTS = (
    "",
    "a",
    "\0",
    "é" * 17,
    "x" * 200,
    "\u202e",
    "w",
    "h",
    "b",
    "ask",
    "track",
    "bps",
    "at_ms",
    "residual",
)


def plain(rng: Random) -> Bytes:
    """A mutator of bytes that needs no library: flips, cuts, repeats, and inserts."""

    def mutated(data: bytes) -> bytes:
        changed = bytearray(data)
        for _ in range(1 + rng.randrange(3)):
            at = rng.randrange(len(changed) + 1)
            what = rng.randrange(5)
            if what == 0 and changed:
                changed[at % len(changed)] ^= 1 << rng.randrange(8)
            elif what == 1:
                del changed[at : at + 1 + rng.randrange(16)]
            elif what == 2:
                changed[at:at] = rng.randbytes(1 + rng.randrange(8))
            elif what == 3:
                changed[at : at + 4] = rng.choice(
                    (b"\0" * 4, b"\xff" * 4, b"\0\0\1\x42", b"\x7f\xff\xff\xff")
                )
            else:
                start = rng.randrange(len(changed) + 1)
                changed[at:at] = changed[start : start + 1 + rng.randrange(32)]
        return bytes(changed)

    return mutated


def each_part(*mutators: Mutator | None) -> Mutator:
    """One part of the input is changed, each by its own mutator; None takes plain bytes. The last repeats."""

    def mutated(data: bytes, rng: Random, raw: Bytes) -> bytes:
        parts = parted(data)
        place = rng.randrange(len(parts))
        chosen = mutators[min(place, len(mutators) - 1)]
        parts[place] = raw(parts[place]) if chosen is None else chosen(parts[place], rng, raw)
        if rng.random() < 0.05:
            parts.insert(place, parts[rng.randrange(len(parts))])
        return joined(parts)

    return mutated


def changed_values(data: bytes, rng: Random, raw: Bytes) -> bytes:
    """A message with another value somewhere, or other bytes; most often with the checksum that belongs to it."""
    dice = rng.random()
    if dice < 0.1:
        return raw(data)
    if dice < 0.4:
        return with_checksum(raw(data[:-_CRC_BYTES]))
    try:
        values = msgpack.unpackb(data, raw=False, strict_map_key=False)
        changed = _changed(values[:-1], rng, raw)
        return with_checksum(
            msgpack.packb([*changed, 2**32 - 1], unicode_errors="surrogatepass")[:-_CRC_BYTES]
        )
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException):
        return with_checksum(raw(data[:-_CRC_BYTES]))


changed_parts = each_part(changed_values)


def with_checksum(body: bytes, payload: bytes = b"") -> bytes:
    """A message's bytes up to its checksum, and the checksum."""
    return body + b"\xce" + zlib.crc32(body, zlib.crc32(payload)).to_bytes(4, "big")


def _changed(values: Any, rng: Random, raw: Bytes) -> Any:
    """The same tree with one or two nodes changed."""
    for _ in range(1 + (rng.random() < 0.3)):
        values = _one_changed(values, rng, raw)
    return values


def _one_changed(value: Any, rng: Random, raw: Bytes) -> Any:
    if isinstance(value, list) and value and rng.random() < 0.9:
        value = list(value)
        place = rng.randrange(len(value))
        dice = rng.random()
        if dice < 0.05:
            del value[place]
        elif dice < 0.1:
            copied = value[rng.randrange(len(value))]
            # An array that holds thousands already, thousands of times, would be gigabytes.
            most = 2 if isinstance(copied, list | dict) else 3000
            value[place:place] = [copied] * min(most, rng.choice((1, 1, 2, 40, 3000)))
        else:
            value[place] = _one_changed(value[place], rng, raw)
        return value
    if isinstance(value, dict) and rng.random() < 0.9:
        changed = dict(value)
        key = rng.choice((*changed, *_TEXTS[:12]))
        if rng.random() < 0.2:
            changed.pop(key, None)
        else:
            changed[key] = _one_changed(changed.get(key, 0), rng, raw)
        return changed
    return _other(value, rng, raw)


def _other(value: Any, rng: Random, raw: Bytes) -> Any:
    dice = rng.random()
    if isinstance(value, bytes) and dice < 0.9:
        return raw(value)
    if isinstance(value, bool) and dice < 0.7:
        return not value
    if isinstance(value, int) and dice < 0.75:
        return rng.choice((value + 1, value - 1, -value, value ^ 1 << rng.randrange(63), rng.randrange(600)))
    if isinstance(value, str) and dice < 0.7:
        return raw(value.encode("utf-8", "surrogatepass")).decode("utf-8", "replace")
    return rng.choice(_REPLACEMENTS)(rng)


def _nested(rng: Random) -> Any:
    nest: Any = []
    for _ in range(rng.choice((1, 3, 100, 600))):
        nest = [nest]
    return nest


_REPLACEMENTS: Sequence[Callable[[Random], Any]] = (
    lambda rng: rng.choice(_NUMBERS),
    lambda rng: rng.choice(_LARGE),
    lambda rng: rng.choice(_REALS),
    lambda rng: rng.choice(_TEXTS),
    lambda rng: rng.choice((None, True, False, [], {}, b"", msgpack.ExtType(1, b"x"))),
    lambda rng: rng.randbytes(rng.choice((1, 16, 300))),
    _nested,
)


def joined(parts: Sequence[bytes]) -> bytes:
    """One input: each part behind its length in three bytes."""
    return b"".join(len(part).to_bytes(3, "big") + part for part in parts)


def parted(data: bytes, *, least: int = 1) -> list[bytes]:
    """The parts of any input whatever; missing ones are empty, and a length too long ends with the input."""
    found: list[bytes] = []
    at = 0
    while at + 3 <= len(data) and len(found) < _MOST_PARTS:
        end = at + 3 + int.from_bytes(data[at : at + 3], "big")
        found.append(data[at + 3 : end])
        at = end
    return found + [b""] * (least - len(found))
