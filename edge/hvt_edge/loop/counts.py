"""What the frame loop counts."""

from __future__ import annotations

from dataclasses import dataclass, field

from hvt_common.units import SECOND_NS
from hvt_common.values import Frame
from hvt_edge.loop.cpu import CpuMeter

__all__ = ["FrameCounts"]


@dataclass(slots=True)
class FrameCounts:
    """Frames of one run."""

    captured: int = 0
    encoded: int = 0
    dropped_link: int = 0
    """Before encoding: the link had no room."""
    dropped_cpu: int = 0
    """Before encoding: the machine was behind."""
    unanalyzed: int = 0
    """Coded, or left out by frame decimation, and skipped by perception, because stills or detection were behind."""
    encode_ns: int = 0
    paused_ns: int = 0
    """How long the clock of a clip stood still, because the machine was too slow to play it in real time."""
    newest_came_ns: int | None = None
    """When the source gave the newest frame; None before the first."""
    last_index: int = -1
    first_capture_ns: int | None = None
    last_capture_ns: int = 0
    cpu: CpuMeter = field(default_factory=CpuMeter)
    _measured: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)
    """Captured, dropped for want of time, not analyzed, time of encoding and of perception when it was measured."""

    @property
    def dropped(self) -> int:
        """Before encoding."""
        return self.dropped_link + self.dropped_cpu

    @property
    def encode_ms(self) -> float:
        """Mean of one frame."""
        return self.encode_ns / max(1, self.encoded) / 1e6

    def note(self, frame: Frame, *, encode_ns: int) -> None:
        """This frame was encoded."""
        if self.first_capture_ns is None:
            self.first_capture_ns = frame.capture_ns
        self.last_index, self.last_capture_ns = frame.index, frame.capture_ns
        self.encoded += 1
        self.encode_ns += encode_ns

    def measure_cpu(self, *, perception_ns: int) -> None:
        """About once a second: what all frames would have taken, from what those did that were not left out."""
        here = (self.captured, self.dropped_cpu, self.unanalyzed, self.encode_ns, perception_ns)
        captured, dropped, unanalyzed, encode_ns, spent_ns = (
            new - old for new, old in zip(here, self._measured, strict=True)
        )
        self._measured = here
        video, perception = captured - dropped, captured - dropped - unanalyzed
        scale = encode_ns * captured / max(1, video) + spent_ns * captured / max(1, perception)
        scale = scale / (encode_ns + spent_ns) if encode_ns + spent_ns else 1.0
        self.cpu.measure(scale=scale, short=bool(dropped or unanalyzed))

    def duration_s(self, fps: float) -> float:
        """From the first frame sent to the last by their capture, with one frame's length."""
        if self.first_capture_ns is None:
            return 0.0
        return (self.last_capture_ns - self.first_capture_ns) / SECOND_NS + 1 / fps
