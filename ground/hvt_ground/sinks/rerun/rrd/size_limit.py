"""How large a recording may be: what is worth writing depends on how many bytes the link brought."""

from __future__ import annotations

__all__ = ["FIXED_BYTES", "TABLE_BYTES", "SizeLimit"]

FIXED_BYTES = 77_000
"""About what the blueprint and the static values cost."""

TABLE_BYTES = 2_000
"""About what a table costs in each fold before its first row: a chunk and its columns."""

_HEAD_START_BYTES = 30_000
"""Beyond the ratio, so that the first pictures of a flight are shown."""


class SizeLimit:
    """Counts what came over the link and what was written for it."""

    def __init__(self) -> None:
        self.received_bytes = 0
        self.logged_bytes = FIXED_BYTES
        """About, once folded."""

    def has(self, size_bytes: int, *, ratio: float) -> bool:
        """Whether the recording stays below ``ratio`` times the bytes received with so much more in it."""
        allowed = ratio * self.received_bytes + FIXED_BYTES + _HEAD_START_BYTES
        return self.logged_bytes + size_bytes <= allowed
