"""An adaptive binary range coder: a few hundred small numbers in as few bytes as their spread allows.

Binary decisions are coded with the probability that a `Context` has learned for them, as in LZMA and CABAC (Martin,
"Range encoding", 1979). All arithmetic is on whole numbers, so both sides learn the very same. `Encoder` and
`Decoder` have the same methods with the same arguments: the encoder writes the value it is given and returns it, the
decoder takes no notice of it and returns the one it reads. So a syntax is written down once for both.
"""

from abc import ABC, abstractmethod
from typing import Final

from hvt_common.protocol.messages.fields import WireError

_ONE: Final = 1 << 16
_SLOWEST: Final = 30
_TOP: Final = 1 << 24
_FULL: Final = (1 << 32) - 1
_WINDOW_BYTES: Final = 4
_LONGEST_PREFIX: Final = 33


class Context:
    """The learned probability of one kind of decision: ``zero`` of 65536 that it is 0."""

    __slots__ = ("seen", "zero")

    def __init__(self) -> None:
        self.zero = _ONE // 2
        self.seen = 0

    def learn(self, bit: int) -> None:
        """Move towards the coded bit, by 1/2, 1/3, 1/4 … and at last 1/32 of the way, in whole numbers."""
        if bit:
            self.zero -= self.zero // (self.seen + 2)
        else:
            self.zero += (_ONE - self.zero) // (self.seen + 2)
        if self.seen < _SLOWEST:
            self.seen += 1


class NumberContexts:
    """The contexts of one kind of whole number: is it zero, its sign, how many bits it has, the highest of them."""

    __slots__ = ("high", "length", "nonzero", "sign")

    def __init__(self) -> None:
        self.nonzero = Context()
        self.sign = Context()
        self.length = [Context() for _ in range(_LONGEST_PREFIX)]
        self.high = [Context() for _ in range(_LONGEST_PREFIX)]


class Coder(ABC):
    """Numbers as decisions; the same for both sides."""

    __slots__ = ()

    @abstractmethod
    def bit(self, context: Context, bit: int) -> int:
        """Code one decision, 0 or 1."""

    @abstractmethod
    def plain(self, value: int, bits: int) -> int:
        """Code a number below ``2 ** bits`` of which nothing is known, highest bit first."""

    def unsigned(self, numbers: NumberContexts, value: int) -> int:
        """A whole number from 0 up to 2^33 - 2, as Elias gamma of ``value + 1``.

        Its length in unary and its highest bits are decisions, the rest is plain.
        """
        wanted = (value + 1).bit_length() - 1
        length = 0
        while self.bit(numbers.length[length], int(length < wanted)):
            length += 1
            if length == _LONGEST_PREFIX:
                raise WireError(f"a number of more than {_LONGEST_PREFIX} bits in coded boxes")
        if length == 0:
            return 0
        rest = length - 1
        high = self.bit(numbers.high[length], (value + 1) >> rest & 1)
        low = self.plain((value + 1) & ((1 << rest) - 1), rest)
        return ((2 | high) << rest | low) - 1

    def signed(self, numbers: NumberContexts, value: int) -> int:
        """Zero or not, the sign, and the distance from zero less one."""
        if not self.bit(numbers.nonzero, int(value != 0)):
            return 0
        negative = self.bit(numbers.sign, int(value < 0))
        size = self.unsigned(numbers, abs(value) - 1) + 1
        return -size if negative else size


class Encoder(Coder):
    """Writes decisions; `finish` gives the bytes."""

    __slots__ = ("_low", "_range", "_shifts")

    def __init__(self) -> None:
        # Python's whole numbers have no end, so that a carry needs no care; steps are a few hundred bytes long.
        self._low = 0
        self._range = _FULL
        self._shifts = 0

    def bit(self, context: Context, bit: int) -> int:
        bound = (self._range >> 16) * context.zero
        if bit:
            self._low += bound
            self._range -= bound
        else:
            self._range = bound
        context.learn(bit)
        self._normalise()
        return bit

    def plain(self, value: int, bits: int) -> int:
        for place in range(bits - 1, -1, -1):
            self._range >>= 1
            if value >> place & 1:
                self._low += self._range
            self._normalise()
        return value

    def finish(self) -> bytes:
        """The shortest bytes for all coded bits; the reader continues them with zeros."""
        for length in range(_WINDOW_BYTES + 1):
            step = 1 << 8 * (_WINDOW_BYTES - length)
            value = -(-self._low // step) * step
            if value < self._low + self._range:
                whole = value.to_bytes(self._shifts + _WINDOW_BYTES, "big")
                return whole[: self._shifts + length]
        raise AssertionError("four bytes always tell one number of 32 bits from the next")

    def _normalise(self) -> None:
        while self._range < _TOP:
            self._low <<= 8
            self._range <<= 8
            self._shifts += 1


class Decoder(Coder):
    """Reads decisions; whatever the bytes, it ends with values or a `WireError`."""

    __slots__ = ("_code", "_data", "_next", "_range")

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._code = int.from_bytes(data[:_WINDOW_BYTES].ljust(_WINDOW_BYTES, b"\0"), "big")
        self._next = _WINDOW_BYTES
        self._range = _FULL

    def bit(self, context: Context, bit: int) -> int:  # noqa: ARG002 - the encoder writes it
        bound = (self._range >> 16) * context.zero
        read = int(self._code >= bound)
        if read:
            self._code -= bound
            self._range -= bound
        else:
            self._range = bound
        context.learn(read)
        self._normalise()
        return read

    def plain(self, value: int, bits: int) -> int:  # noqa: ARG002 - the encoder writes it
        read = 0
        for _ in range(bits):
            self._range >>= 1
            one = int(self._code >= self._range)
            if one:
                self._code -= self._range
            read = read << 1 | one
            self._normalise()
        return read

    def finish(self) -> None:
        """Check that exactly these bytes were needed; `WireError` otherwise."""
        if self._next - len(self._data) > _WINDOW_BYTES:
            raise WireError("coded boxes are shorter than what they say")
        if self._next < len(self._data):
            raise WireError(f"{len(self._data) - self._next} bytes too many after the coded boxes")

    def _normalise(self) -> None:
        while self._range < _TOP:
            fresh = self._data[self._next] if self._next < len(self._data) else 0
            if self._next - len(self._data) >= _WINDOW_BYTES:
                raise WireError("coded boxes are shorter than what they say")
            self._code = (self._code << 8 | fresh) & _FULL
            self._range <<= 8
            self._next += 1
