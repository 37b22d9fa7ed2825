"""Several byte strings in one fuzzing input, so that each can be changed by itself."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["joined", "parted"]

_MOST = 8


def joined(parts: Sequence[bytes]) -> bytes:
    """One input: each part behind its length in three bytes."""
    return b"".join(len(part).to_bytes(3, "big") + part for part in parts)


def parted(data: bytes, *, least: int = 1) -> list[bytes]:
    """The parts of any input whatever; missing ones are empty, and a length too long ends with the input."""
    found: list[bytes] = []
    at = 0
    while at + 3 <= len(data) and len(found) < _MOST:
        end = at + 3 + int.from_bytes(data[at : at + 3], "big")
        found.append(data[at + 3 : end])
        at = end
    return found + [b""] * (least - len(found))
