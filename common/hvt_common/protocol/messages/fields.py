"""The kinds of field a message may have. Each one checks the same bounds when it packs and when it parses.

`Kind.encode` takes one of our own values and raises ValueError when it is out of bounds: that is a bug here.
`Kind.decode` takes a value from MessagePack and raises `WireError`: the other side sent a bad message.
"""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sized
from dataclasses import MISSING, dataclass, field
from typing import Any

U32 = 2**32 - 1
U64 = 2**64 - 1
I63 = 2**63 - 1

_MOST_REAL = 1e300
REFUSED_CHARACTERS = ((0x00, 0x1F), (0x7F, 0x9F), (0x2028, 0x202E), (0x2066, 0x2069))
"""First and last code points: controls, the two that begin a line or a paragraph, changes of direction."""
_REFUSED = re.compile(
    "[" + "".join(f"{chr(low)}-{chr(high)}" for low, high in REFUSED_CHARACTERS) + "\ud800-\udfff]"
)


class WireError(Exception):
    """A message that cannot be used; the text says why. Count it and skip it."""


class _UnsendableError(ValueError):
    """Says which value: those around it have nothing to add."""


class Kind(ABC):
    """A field's type, bounds and coding."""

    __slots__ = ()

    def encode(self, value: Any) -> Any:
        """The value as MessagePack is to hold it; ValueError when it is out of bounds."""
        try:
            raw = self._encode(value)
            self.decode(raw)  # sent and received values obey the same rules
        except _UnsendableError:
            raise
        except (WireError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise _UnsendableError(f"{value!r} cannot be sent: {error}") from error
        return raw

    @abstractmethod
    def decode(self, raw: Any) -> Any:
        """The value of a MessagePack object; WireError when of another type or out of bounds."""

    @abstractmethod
    def schema(self) -> dict[str, Any]:
        """Type and bounds as docs/wire.json holds them."""

    def _encode(self, value: Any) -> Any:
        return value


def wire_field(kind: Kind, *, default: Any = MISSING, since: int = 0, before: Any = None) -> Any:
    """A dataclass field that crosses the wire as ``kind``; fields are sent in the order they are declared.

    One that was added later has a ``default``, which it has in the messages of earlier senders; it stands behind all
    that have none. One that is there ``since`` a version is ``before`` in messages of earlier ones.
    """
    optional = default is not MISSING and not since
    metadata = {"wire": kind, "optional": optional, "default": default, "since": since, "before": before}
    if isinstance(default, dict):
        return field(metadata=metadata, default_factory=dict)
    return field(metadata=metadata, default=default)


@dataclass(frozen=True, slots=True)
class Int(Kind):
    """A whole number in ``low … high``; a boolean is not a number."""

    low: int
    high: int

    def _encode(self, value: Any) -> Any:
        return value.__index__()

    def decode(self, raw: Any) -> Any:
        if type(raw) is not int:
            raise WireError(f"{type(raw).__name__} in place of a whole number")
        if not self.low <= raw <= self.high:
            raise WireError(f"{raw} is outside {self.low}…{self.high}")
        return raw

    def schema(self) -> dict[str, Any]:
        return {"type": "int", "low": self.low, "high": self.high}


@dataclass(frozen=True, slots=True)
class Scaled(Kind):
    """A real number in ``low … high`` sent as a whole number of ``1/per``."""

    low: float
    high: float
    per: int

    def _encode(self, value: Any) -> Any:
        return round(float(value) * self.per)

    def decode(self, raw: Any) -> Any:
        if type(raw) is not int:
            raise WireError(f"{type(raw).__name__} in place of a whole number of 1/{self.per}")
        if not self.low * self.per <= raw <= self.high * self.per:
            raise WireError(f"{raw}/{self.per} is outside {self.low:g}…{self.high:g}")
        return raw / self.per

    def schema(self) -> dict[str, Any]:
        low, high = (round(bound * self.per) for bound in (self.low, self.high))
        return {"type": "int", "low": low, "high": high, "per": self.per}


@dataclass(frozen=True, slots=True)
class Real(Kind):
    """A finite 64-bit float in ``low … high``."""

    low: float
    high: float

    def _encode(self, value: Any) -> Any:
        return float(value)

    def decode(self, raw: Any) -> Any:
        if type(raw) is not float or not math.isfinite(raw):
            found = raw if type(raw) is float else type(raw).__name__
            raise WireError(f"{found} in place of a finite float")
        if not self.low <= raw <= self.high:
            raise WireError(f"{raw:g} is outside {self.low:g}…{self.high:g}")
        return raw

    def schema(self) -> dict[str, Any]:
        return {"type": "float", "low": self.low, "high": self.high}


@dataclass(frozen=True, slots=True)
class Flag(Kind):
    """True or False."""

    def decode(self, raw: Any) -> Any:
        if type(raw) is not bool:
            raise WireError(f"{type(raw).__name__} in place of a boolean")
        return raw

    def schema(self) -> dict[str, Any]:
        return {"type": "bool"}


@dataclass(frozen=True, slots=True)
class Text(Kind):
    """UTF-8 of at most ``max_bytes`` without controls and changes of direction, which could rewrite a terminal.

    The rule is the same under every version of Unicode; a display replaces characters that do not print
    (`units.shown_text`).
    """

    max_bytes: int

    def _encode(self, value: Any) -> Any:
        return value[:]  # also makes a plain str of a StrEnum

    def decode(self, raw: Any) -> Any:
        if type(raw) is not str:
            raise WireError(f"{type(raw).__name__} in place of text")
        if len(raw) > self.max_bytes or len(raw.encode("utf-8", "surrogatepass")) > self.max_bytes:
            raise WireError(f"text of {len(raw)} characters is longer than {self.max_bytes} bytes")
        if _REFUSED.search(raw) is not None:
            raise WireError(f"text {raw!r:.40} has a control or a change of direction")
        return raw

    def schema(self) -> dict[str, Any]:
        return {"type": "str", "most_bytes": self.max_bytes}


@dataclass(frozen=True, slots=True)
class Blob(Kind):
    """``least`` to ``max_bytes`` bytes with a coding of their own."""

    max_bytes: int
    least: int = 0

    def decode(self, raw: Any) -> Any:
        if type(raw) is not bytes:
            raise WireError(f"{type(raw).__name__} in place of bytes")
        if not self.least <= len(raw) <= self.max_bytes:
            raise WireError(f"{len(raw)} bytes where {self.least} to {self.max_bytes} are allowed")
        return raw

    def schema(self) -> dict[str, Any]:
        return {"type": "bin", "least_bytes": self.least, "most_bytes": self.max_bytes}


def fitted_text(text: str, max_bytes: int) -> str:
    """Text of any origin, such as a model's class name, as `Text` takes it: cut between characters, no controls."""
    plain = _REFUSED.sub("?", text)
    return plain.encode("utf-8", "replace")[:max_bytes].decode("utf-8", "ignore")


@dataclass(frozen=True, slots=True)
class OneOf(Kind):
    """One of a few words, sent as its position."""

    words: tuple[str, ...]

    def _encode(self, value: Any) -> Any:
        return self.words.index(value)

    def decode(self, raw: Any) -> Any:
        return self.words[Int(0, len(self.words) - 1).decode(raw)]

    def schema(self) -> dict[str, Any]:
        return {
            "type": "int",
            "low": 0,
            "high": len(self.words) - 1,
            "words": [str(one) for one in self.words],
        }


@dataclass(frozen=True, slots=True)
class Word(Kind):
    """One of some known words, sent as its position, or any other text."""

    words: tuple[str, ...]
    max_bytes: int

    def _encode(self, value: Any) -> Any:
        return self.words.index(value) if value in self.words else value[:]

    def decode(self, raw: Any) -> Any:
        if type(raw) is str:
            return Text(self.max_bytes).decode(raw)
        return self.words[Int(0, len(self.words) - 1).decode(raw)]

    def schema(self) -> dict[str, Any]:
        return {"type": "word", "words": list(self.words), "most_bytes": self.max_bytes}


@dataclass(frozen=True, slots=True)
class Listed(Kind):
    """The index of a text in a list that another message has brought, at most ``high``, or any text."""

    high: int
    max_bytes: int

    def decode(self, raw: Any) -> Any:
        return Text(self.max_bytes).decode(raw) if type(raw) is str else Int(0, self.high).decode(raw)

    def schema(self) -> dict[str, Any]:
        return {"type": "listed", "high": self.high, "most_bytes": self.max_bytes}


@dataclass(frozen=True, slots=True)
class Scalar(Kind):
    """A parameter's value: a whole number of 64 bits, a finite float or short text."""

    max_bytes: int = 64

    def decode(self, raw: Any) -> Any:
        if type(raw) is str:
            return Text(self.max_bytes).decode(raw)
        if type(raw) is float:
            return Real(-_MOST_REAL, _MOST_REAL).decode(raw)
        return Int(-I63, I63).decode(raw)

    def schema(self) -> dict[str, Any]:
        return {"type": "scalar", "low": -I63, "high": I63, "most": _MOST_REAL, "most_bytes": self.max_bytes}


@dataclass(frozen=True, slots=True)
class ListOf(Kind):
    """``least`` to ``max_items`` of one kind, as a tuple."""

    inner: Kind
    max_items: int
    least: int = 0

    def _encode(self, value: Any) -> Any:
        return [self.inner.encode(item) for item in value]

    def decode(self, raw: Any) -> Any:
        _check_size(raw, list, "list", self.max_items)
        if len(raw) < self.least:
            raise WireError(f"{len(raw)} numbers in place of {self.least}")
        return tuple(self.inner.decode(item) for item in raw)

    def schema(self) -> dict[str, Any]:
        return {"type": "array", "least": self.least, "most": self.max_items, "of": self.inner.schema()}


@dataclass(frozen=True, slots=True)
class Box(ListOf):
    """x1, y1, x2, y2 of one kind, x2 and y2 exclusive: never inside out; ``empty``: it may have no inside."""

    max_items: int = 4
    least: int = 4
    empty: bool = True

    def decode(self, raw: Any) -> Any:
        items = ListOf.decode(self, raw)
        x1, y1, x2, y2 = items
        if x2 < x1 or y2 < y1:
            raise WireError(f"box {items} is inside out")
        if not self.empty and (x2 == x1 or y2 == y1):
            raise WireError(f"box {items} is empty")
        return items

    def schema(self) -> dict[str, Any]:
        return ListOf.schema(self) | {"box": "may be empty" if self.empty else "never empty"}


@dataclass(frozen=True, slots=True)
class MapOf(Kind):
    """At most ``max_items`` named values; names are `Text` of at most ``key_bytes``."""

    inner: Kind
    max_items: int
    key_bytes: int = 32

    def _encode(self, value: Any) -> Any:
        return {key: self.inner.encode(item) for key, item in value.items()}

    def decode(self, raw: Any) -> Any:
        _check_size(raw, dict, "map", self.max_items)
        name = Text(self.key_bytes)
        return {name.decode(key): self.inner.decode(item) for key, item in raw.items()}

    def schema(self) -> dict[str, Any]:
        of = self.inner.schema()
        return {"type": "map", "most": self.max_items, "key_bytes": self.key_bytes, "of": of}


def _check_size(raw: Any, wanted: type[Sized], name: str, most: int) -> None:
    if not isinstance(raw, wanted):
        raise WireError(f"{type(raw).__name__} in place of a {name}")
    if len(raw) > most:
        raise WireError(f"{name} of {len(raw)} where at most {most} are allowed")
