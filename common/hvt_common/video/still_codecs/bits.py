"""Bit strings with the variable-length numbers that H.264 and HEVC headers are made of (clause 9 of both)."""

from __future__ import annotations

import re

_NEEDS_ESCAPE = re.compile(rb"\x00\x00(?=[\x00-\x03])")


class BitWriter:
    """Puts fields together, most significant bit first; each method returns the writer."""

    def __init__(self) -> None:
        self._text: list[str] = []

    def u(self, value: int, bits: int) -> BitWriter:
        """``value`` in so many bits."""
        self._text.append(f"{value:0{bits}b}")
        return self

    def ue(self, *values: int) -> BitWriter:
        """Each value as an unsigned Exp-Golomb number."""
        for value in values:
            digits = f"{value + 1:b}"
            self._text.append("0" * (len(digits) - 1) + digits)
        return self

    def se(self, value: int) -> BitWriter:
        """``value`` as a signed Exp-Golomb number."""
        return self.ue(2 * value - 1 if value > 0 else -2 * value)

    def ended(self, *, stop: str = "1", fill: str = "0") -> bytes:
        """The bytes, with ``stop`` behind the last field and then ``fill`` up to a whole byte."""
        text = "".join(self._text) + stop
        text += fill * (-len(text) % 8)
        return int(text, 2).to_bytes(len(text) // 8, "big")


class BitReader:
    """Reads fields back, of bytes that this machine's own encoder wrote."""

    def __init__(self, data: bytes) -> None:
        self._text = f"{int.from_bytes(data, 'big'):0{len(data) * 8}b}"
        self.position = 0

    def u(self, bits: int) -> int:
        """The next bits as a number."""
        start, self.position = self.position, self.position + bits
        return int(self._text[start : self.position], 2)

    def ue(self) -> int:
        """The next unsigned Exp-Golomb number."""
        zeros = self._text.index("1", self.position) - self.position
        self.position += zeros
        return self.u(zeros + 1) - 1

    def ues(self, number: int) -> list[int]:
        """Read so many of them."""
        return [self.ue() for _ in range(number)]

    def se(self) -> int:
        """The next signed Exp-Golomb number."""
        code = self.ue()
        return (code + 1) // 2 if code % 2 else -(code // 2)

    def next_byte(self) -> int:
        """The index of the first byte that is not begun."""
        return -(-self.position // 8)


def unescaped(unit: bytes) -> bytes:
    """Without the emulation prevention bytes (clause 7.4.1)."""
    return unit.replace(b"\x00\x00\x03", b"\x00\x00")


def escaped(unit: bytes) -> bytes:
    """With emulation prevention bytes: no start code can be in it, whatever the bytes are."""
    guarded = _NEEDS_ESCAPE.sub(b"\x00\x00\x03", unit)
    return guarded + b"\x03" if guarded.endswith(b"\x00") else guarded
