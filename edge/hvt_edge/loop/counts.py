"""What the frame loop counts."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FrameCounts"]


@dataclass(slots=True)
class FrameCounts:
    """Frames of one run."""

    captured: int = 0
    encoded: int = 0
    dropped: int = 0
    """Before encoding, because the link or the machine was behind."""
    unanalyzed: int = 0
    """Coded, or left out by frame decimation, and skipped by perception, because stills or detection were behind."""
    encode_ns: int = 0
    first_index: int | None = None
    last_index: int = -1

    @property
    def encode_ms(self) -> float:
        """Mean of one frame."""
        return self.encode_ns / max(1, self.encoded) / 1e6

    def note(self, index: int, *, encode_ns: int) -> None:
        """A frame of this index was encoded."""
        if self.first_index is None:
            self.first_index = index
        self.last_index = index
        self.encoded += 1
        self.encode_ns += encode_ns

    def duration_s(self, fps: float) -> float:
        """From the first frame sent to the last, with one frame's length."""
        return 0.0 if self.first_index is None else (self.last_index - self.first_index + 1) / fps
