"""Quantities as people write them (``800kbps``, ``2s``, ``1280x720``); each parser raises `UserError`."""

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction

from hvt_common.errors import UserError

SECOND_NS = 1_000_000_000
_NUMBER = r"([0-9]+(?:\.[0-9]*)?|\.[0-9]+)"
_BITRATE = re.compile(_NUMBER + r"\s*(bps|bit/s|kbps|kbit/s|k|Mbps|Mbit/s|M)?", re.IGNORECASE)
_DURATION = re.compile(_NUMBER + r"\s*(ms|s|min|m|h)?")
_BYTES = re.compile(_NUMBER + r"\s*(B|kB|MB|GB)?", re.IGNORECASE)
_SIZE = re.compile(r"([0-9]{1,9})\s*[xX]\s*([0-9]{1,9})")
_SPAN = re.compile(_NUMBER + r"\s*(s|min|h|days?|d|weeks?)")
_AMOUNT = re.compile(_NUMBER + r"\s*(kB|MB|GB|TB)", re.IGNORECASE)
_SPAN_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_AMOUNT_UNITS = {"": 1, "b": 1, "k": 1e3, "m": 1e6, "g": 1e9, "t": 1e12}
_BITRATE_UNITS = {"": 1, "b": 1, "k": 1_000, "m": 1_000_000}
_DURATION_UNITS = {"": 1.0, "ms": 1e-3, "s": 1.0, "m": 60.0, "mi": 60.0, "h": 3600.0}
_LIMIT_BPS = 1_000_000_000
_LIMIT_BYTES = 10**12
_LIMIT_S = 10_000_000.0
_LONGEST_S = 3_660 * 86_400.0
_LARGEST_BYTES = 10**15


def parse_bitrate(text: str, *, name: str) -> int:
    """``800kbps`` → 800000 bits a second; a bare number is bits a second."""
    bps = _quantity(text, _BITRATE, _BITRATE_UNITS)
    if not 1 <= bps <= _LIMIT_BPS:
        raise UserError(
            f"{name} {text!r} is not a bitrate: write 800kbps, 0.8Mbps or 800000 (bits a second), at most 1000Mbps"
        )
    return round(bps)


def _quantity(text: str, pattern: re.Pattern[str], units: Mapping[str, float], *, letters: int = 1) -> float:
    # NaN where it is none. The first letters of a unit tell it.
    match = pattern.fullmatch(text.strip())
    return float(match[1]) * units[(match[2] or "")[:letters].lower()] if match else math.nan


def parse_bytes(text: str, *, name: str) -> int:
    """``200MB`` → 200000000 bytes; a bare number is bytes."""
    size_bytes = _quantity(text, _BYTES, _AMOUNT_UNITS)
    if not 0 <= size_bytes <= _LIMIT_BYTES:
        raise UserError(
            f"{name} {text!r} is not a number of bytes: write 200MB, 64kB or 1GB, at most 1000 GB"
        )
    return round(size_bytes)


def parse_duration_s(text: str, *, name: str) -> float:
    """``500ms`` → 0.5 seconds; a bare number is seconds."""
    seconds = _quantity(text, _DURATION, _DURATION_UNITS, letters=2)
    if not 0 <= seconds <= _LIMIT_S:
        raise UserError(
            f"{name} {text!r} is not a duration: write 2s, 500ms or 1min, at most {_LIMIT_S:.0f} s"
        )
    return seconds


@dataclass(frozen=True, slots=True)
class Limit:
    """An age or an amount: one of both."""

    seconds: float | None = None
    size_bytes: int | None = None

    def __str__(self) -> str:
        """As `parse_limit` reads it."""
        if self.seconds is not None:
            return f"{self.seconds:.15g}s"
        return f"{(self.size_bytes or 0) / 1e6:.15g}MB"


def parse_limit(text: str, *, name: str) -> Limit:
    """``14days`` or ``200GB``; a bare number could be either and is neither."""
    seconds, size_bytes = _quantity(text, _SPAN, _SPAN_UNITS), _quantity(text, _AMOUNT, _AMOUNT_UNITS)
    if 1 <= seconds <= _LONGEST_S:
        return Limit(seconds=seconds)
    if 1_000_000 <= size_bytes <= _LARGEST_BYTES:
        return Limit(size_bytes=round(size_bytes))
    raise UserError(
        f"{name} {text!r} is neither a time nor a size: write 1h, 14days or 200GB, at least 1s or 1MB"
    )


def parse_age_s(text: str, *, name: str, also: str = "") -> float:
    """``14days`` → seconds; ``also``: other accepted forms, for the sentence."""
    with suppress(UserError):
        seconds = parse_limit(text, name=name).seconds
        if seconds is not None:
            return seconds
    raise UserError(f"{name} {text!r} is no time: write 12h or 3days{also}")


def parse_size(text: str, *, name: str) -> tuple[int, int]:
    """``1280x720`` → (width, height) in pixels."""
    match = _SIZE.fullmatch(text.strip())
    if not match:
        raise UserError(f"{name} {text!r} is not a size: write WIDTHxHEIGHT, for example 1280x720")
    return int(match[1]), int(match[2])


def parse_share(text: str, *, name: str) -> float:
    """``0.8125`` or ``81.25%`` → a share of 0…1."""
    stripped = text.strip()
    try:
        share = float(stripped.removesuffix("%")) / (100 if stripped.endswith("%") else 1)
    except ValueError:
        share = math.nan
    if not 0 <= share <= 1:
        raise UserError(f"{name} {text!r} is not a share: write a number from 0 to 1, or a percentage")
    return share


def bitrate_text(bps: float) -> str:
    """800000 → ``800 kbps``."""
    return f"{bps / 1e6:.2f} Mbps" if bps >= 1e6 else f"{bps / 1e3:.0f} kbps"


def utc_text(unix_ns: int, *, milliseconds: bool = True) -> str:
    """``2026-11-22T13:01:02.345Z``; empty where no calendar has the time, which may come from the wire."""
    try:
        time = datetime.fromtimestamp(unix_ns // SECOND_NS, UTC)
    except (ValueError, OverflowError, OSError):
        return ""
    rest = f".{unix_ns // 1_000_000 % 1000:03d}" if milliseconds else ""
    return time.strftime("%Y-%m-%dT%H:%M:%S") + rest + "Z"


def exact_rate(fps: float) -> Fraction:
    """The rate as a fraction, so that no clip is long enough to drift: 29.97 is 2997/100, 30000/1001 itself."""
    return Fraction(fps).limit_denominator(1001)


def shown_text(text: str) -> str:
    """Text of any origin for a terminal: characters that are not printable for this Python are ``?``; lines stay."""
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() or one == "\n" else "?" for one in text)
