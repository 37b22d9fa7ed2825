"""Bit strings: fields of fixed width, and Exp-Golomb codes of order k, which code small numbers in few bits.

A number from 0 up is ``0…0 1 s…s``: with ``q = number + 2^k`` of n bits, n - 1 - k zeros, then the n bits of ``q``
(Teuhola 1978). A signed one is numbered 0, 1, -1, 2, -2 … before. Of order 0 they are those in headers of H.264 and
HEVC (clause 9 of both). Bits fill bytes from the highest.
"""

from __future__ import annotations

import re

from hvt_common.protocol.messages.fields import WireError

_MOST_ZEROS = 40
"""No number that is sent here needs more."""
_NEEDS_ESCAPE = re.compile(rb"\x00\x00(?=[\x00-\x03])")


class BitWriter:
    """Puts fields together; each method returns the writer, or raises ValueError for a number that it cannot say."""

    def __init__(self) -> None:
        self._text: list[str] = []

    def u(self, value: int, bits: int) -> BitWriter:
        """``value`` in ``bits`` bits."""
        if not 0 <= value < 1 << bits:
            raise ValueError(f"{value} is no number of {bits} bits")
        self._text.append(f"{value:0{bits}b}")
        return self

    def ue(self, *values: int, order: int = 0) -> BitWriter:
        """Each value as an unsigned Exp-Golomb number."""
        for value in values:
            digits = f"{value + (1 << order):b}"
            zeros = len(digits) - 1 - order
            if zeros > _MOST_ZEROS:
                raise ValueError(f"{value} is too large for an Exp-Golomb code here")
            self._text.append("0" * zeros + digits)
        return self

    def se(self, value: int, order: int = 0) -> BitWriter:
        return self.ue(2 * value - 1 if value > 0 else -2 * value, order=order)

    def ended(self, *, stop: str = "1", fill: str = "0") -> bytes:
        """The bytes, with ``stop`` behind the last field and then ``fill`` up to a whole byte."""
        text = "".join(self._text) + stop
        text += fill * (-len(text) % 8)
        return int(text or "0", 2).to_bytes(len(text) // 8, "big")


class BitReader:
    """Reads fields back; `WireError` where the bytes end before."""

    def __init__(self, data: bytes) -> None:
        self._text = "".join(f"{one:08b}" for one in data)
        self._position = 0

    def u(self, bits: int) -> int:
        """The next bits as a number."""
        start, end = self._position, self._position + bits
        if end > len(self._text):
            raise WireError("coded numbers are shorter than what they say")
        self._position = end
        return int(self._text[start:end] or "0", 2)

    def ue(self, order: int = 0) -> int:
        zeros = 0
        while not self.u(1):
            zeros += 1
            if zeros > _MOST_ZEROS:
                raise WireError(f"an Exp-Golomb code of more than {_MOST_ZEROS} zeros")
        bits = zeros + order
        return (1 << bits | self.u(bits)) - (1 << order)

    def ues(self, number: int) -> list[int]:
        return [self.ue() for _ in range(number)]

    def se(self, order: int = 0) -> int:
        code = self.ue(order)
        return (code + 1) // 2 if code % 2 else -(code // 2)

    def next_byte(self) -> int:
        """The index of the first byte that is not begun."""
        return -(-self._position // 8)

    def finish(self) -> None:
        """Check that nothing is left but the zeros that fill the last byte; `WireError` otherwise."""
        rest = self._text[self._position :]
        if len(rest) >= 8 or "1" in rest:
            raise WireError(f"{len(rest)} bits too many after coded numbers")


def unescaped(unit: bytes) -> bytes:
    """Without the emulation prevention bytes (clause 7.4.1)."""
    return unit.replace(b"\x00\x00\x03", b"\x00\x00")


def escaped(unit: bytes) -> bytes:
    """With emulation prevention bytes: no start code can be in it, whatever the bytes are."""
    guarded = _NEEDS_ESCAPE.sub(b"\x00\x00\x03", unit)
    return guarded + b"\x03" if guarded.endswith(b"\x00") else guarded
