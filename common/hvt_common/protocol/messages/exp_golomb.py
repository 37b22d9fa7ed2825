"""Exponential-Golomb codes of order k (ITU-T H.264, 9.1; Teuhola 1978): small numbers in few bits, any in some.

A number from 0 up is ``0…0 1 s…s``: with ``q = number + 2^k`` of n bits, n - 1 - k zeros, then the n bits of ``q``. A
signed one is numbered 0, 1, -1, 2, -2 … before. Bits fill bytes from the highest; the last byte is filled with zeros.
"""

from __future__ import annotations

from hvt_common.protocol.messages.fields import WireError

_MOST_ZEROS = 40
"""No number that is sent here needs more."""


class BitWriter:
    """Writes numbers of so many bits, and Exp-Golomb codes."""

    def __init__(self) -> None:
        self._bits = ""

    def plain(self, value: int, bits: int) -> None:
        """A number below ``2 ** bits``, highest bit first; ValueError for another."""
        if not 0 <= value < 1 << bits:
            raise ValueError(f"{value} is no number of {bits} bits")
        self._bits += f"{value:0{bits}b}"

    def signed(self, value: int, order: int) -> None:
        """Any whole number of up to 40 bits."""
        shifted = (2 * value - 1 if value > 0 else -2 * value) + (1 << order)
        digits = f"{shifted:b}"
        zeros = len(digits) - 1 - order
        if zeros > _MOST_ZEROS:
            raise ValueError(f"{value} is too large for an Exp-Golomb code here")
        self._bits += "0" * zeros + digits

    def finish(self) -> bytes:
        """All that was written, filled up with zeros."""
        filled = self._bits.ljust(-(-len(self._bits) // 8) * 8, "0")
        return int(filled or "0", 2).to_bytes(len(filled) // 8, "big")


class BitReader:
    """Reads the bits of a `BitWriter`; `WireError` if the bytes end before."""

    def __init__(self, data: bytes) -> None:
        self._bits = "".join(f"{one:08b}" for one in data)
        self._next = 0

    def plain(self, bits: int) -> int:
        """A number of so many bits."""
        end = self._next + bits
        if end > len(self._bits):
            raise WireError("coded numbers are shorter than what they say")
        value = int(self._bits[self._next : end] or "0", 2)
        self._next = end
        return value

    def signed(self, order: int) -> int:
        """An Exp-Golomb code."""
        zeros = 0
        while not self.plain(1):
            zeros += 1
            if zeros > _MOST_ZEROS:
                raise WireError(f"an Exp-Golomb code of more than {_MOST_ZEROS} zeros")
        bits = zeros + order
        number = (1 << bits | self.plain(bits)) - (1 << order)
        return (number + 1) // 2 if number % 2 else -(number // 2)

    def finish(self) -> None:
        """Check that nothing is left but the zeros that fill the last byte; `WireError` otherwise."""
        rest = self._bits[self._next :]
        if len(rest) >= 8 or "1" in rest:
            raise WireError(f"{len(rest)} bits too many after coded numbers")
