"""Key, length, value (SMPTE ST 336), and how MISB's standards code numbers in it."""

from __future__ import annotations

import math
from collections.abc import Iterable

_SHORT = 128
"""BER lengths and identifiers below take one byte (ITU-T X.690, 8.1.3)."""


def ber_length(size: int) -> bytes:
    """A length: one byte below 128, else how many bytes there are and those (ST 336; ST 0107)."""
    if size < _SHORT:
        return bytes((size,))
    data = whole(size)
    return bytes((0x80 | len(data),)) + data


def ber_oid(number: int) -> bytes:
    """A number from 0 on, seven bits a byte, the first ones first (ITU-T X.690, 8.19)."""
    data = [number & 0x7F]
    while number := number >> 7:
        data.append(0x80 | (number & 0x7F))
    return bytes(reversed(data))


def item(tag: int, value: bytes) -> bytes:
    """One item of a local set."""
    return ber_oid(tag) + ber_length(len(value)) + value


def packet(key: bytes, items: Iterable[bytes]) -> bytes:
    """A set with its 16-byte key, and behind its items the checksum, item 1.

    The checksum is the sum of the 16-bit words from the key to its own length, modulo 2^16 (ST 0601, item 1).
    """
    body = b"".join(items) + b"\x01\x02"
    data = key + ber_length(len(body) + 2) + body
    padded = data + bytes(len(data) % 2)
    return data + (sum(memoryview(padded)[::2]) * 256 + sum(memoryview(padded)[1::2]) & 0xFFFF).to_bytes(2)


def whole(number: int) -> bytes:
    """A number from 0 on, in as few bytes as hold it."""
    return number.to_bytes(max(1, (number.bit_length() + 7) // 8))


def signed(value: float, limit: float, *, size: int) -> bytes:
    """From -limit … limit onto -(2^(8·size-1)-1) … 2^(8·size-1)-1 (ST 0601, items 6, 13 and others).

    What is out of range is the lowest integer, which means just that, or an error.
    """
    top = (1 << (8 * size - 1)) - 1
    if not abs(value) <= limit:
        return (-top - 1).to_bytes(size, signed=True)
    return round(value * top / limit).to_bytes(size, signed=True)


def unsigned(value: float, low: float, high: float, *, size: int) -> bytes:
    """From low … high onto 0 … 2^(8·size)-1 (ST 0601, items 5, 15 and others); empty out of range: it has no code."""
    if not low <= value <= high:
        return b""
    return round((value - low) * ((1 << (8 * size)) - 1) / (high - low)).to_bytes(size)


def imapb(value: float, low: float, high: float, *, size: int) -> bytes:
    """ST 1201, 'Starting Point B'; empty out of range."""
    if not low <= value <= high:
        return b""
    scale = 2.0 ** (8 * size - 1 - math.ceil(math.log2(high - low)))
    offset = scale * low - math.floor(scale * low) if low < 0 < high else 0.0
    return math.floor(scale * (value - low) + offset).to_bytes(size)
