"""The counters of the frame loop, and the processor time that all frames would need, and that is free."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hvt_common.protocol.edge_words import FrameAccount, FrameGroup
from hvt_common.units import SECOND_NS
from hvt_common.values import Frame
from hvt_edge.source.contract import Source
from hvt_edge.video.stage import Action, FrameDecision

STAT = Path("/proc/stat")
_GROUPS = Path("/proc/self/cgroup")
_TOP = Path("/sys/fs/cgroup")
_MOST_SHORT = 600
_IDLE = (3, 4)
"""Columns of idle and iowait in /proc/stat (proc(5)), counted without the name."""
_LEAST_S = 0.1


@dataclass(frozen=True, slots=True)
class Cores:
    """Processor time in cores; 0 where it is not measured."""

    needed: float = 0.0
    """Need of this process, had it left out no frame."""
    free: float = 0.0
    """Cores that other processes leave."""
    taken: float = 0.0
    """Cores that this process takes."""


class CpuMeter:
    """Measures from one call of `measure` to the next."""

    def __init__(self) -> None:
        self._last = _sample()
        self.now = Cores()
        self._short: list[Cores] = []

    def measure(self, *, scale: float, short: bool) -> None:
        """Measure the time since the last call; ``scale``: factor to the need without left-out work.

        ``short``: work was left out for want of time.
        """
        last, here = self._last, _sample()
        if last is None or here is None or here[0] - last[0] < _LEAST_S:
            return
        self._last = here
        wall_s, own_s, busy_s = (new - old for new, old in zip(here, last, strict=True))
        others, taken = max(0.0, busy_s - own_s) / wall_s, own_s / wall_s
        self.now = Cores(
            needed=taken * scale, free=max(0.0, min(len(usable_cores()) - others, quota())), taken=taken
        )
        if short:
            self._short = [*self._short[-_MOST_SHORT:], self.now]

    @property
    def short(self) -> Cores:
        """The mean of the measurements in which work was left out."""
        rows = [(one.needed, one.free, one.taken) for one in self._short] or [(0.0, 0.0, 0.0)]
        return Cores(*(sum(column) / len(rows) for column in zip(*rows, strict=True)))


def processors() -> float:
    """Processors that this process may use: those it may run on, or fewer by the limit of its control group."""
    return min(len(usable_cores()), quota())


def quota(groups: Path = _GROUPS, top: Path = _TOP) -> float:
    """Processors that a container or systemd gives this process: the least of its control group and those above.

    Version 1 or 2. In a container the group's name may differ from its path: the top counts as well.
    """
    limits = [math.inf]
    with contextlib.suppress(OSError):
        for line in groups.read_text(encoding="utf-8").splitlines():
            number, controllers, path = line.split(":", 2)
            if number == "0":
                mounts, files = ["", "unified"], ["cpu.max"]
            elif "cpu" in controllers.split(","):
                mounts, files = ["cpu", controllers], ["cpu.cfs_quota_us", "cpu.cfs_period_us"]
            else:
                continue
            group = Path(path.removeprefix("/"))
            limits += [
                _limit(top / mount / one, files) for mount in mounts for one in (group, *group.parents)
            ]
    return min(limits)


def _limit(group: Path, files: Sequence[str]) -> float:
    try:
        given, period = " ".join((group / name).read_text(encoding="ascii") for name in files).split()
        return float(given) / float(period) if float(given) > 0 else math.inf
    except (OSError, ValueError):  # there is no such group, or it says "max"
        return math.inf


def usable_cores() -> set[int]:
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def _sample() -> tuple[float, float, float] | None:
    # Seconds so far: by the clock, of this process, and of all on the cores that this one may use.
    names = {f"cpu{core}" for core in usable_cores()}
    try:
        rows = [line.split() for line in STAT.read_text(encoding="ascii").splitlines()]
        busy = sum(
            sum(int(value) for place, value in enumerate(row[1:9]) if place not in _IDLE)
            for row in rows
            if row[0] in names
        )
    except (OSError, ValueError, IndexError):
        return None
    return time.monotonic(), time.process_time(), busy / os.sysconf("SC_CLK_TCK")


@dataclass(slots=True)
class FrameCounts:
    """Frames of one run."""

    groups: Counter[FrameGroup] = field(default_factory=Counter)
    """The outcome of each frame that came to the loop, each in one group."""
    source_groups: Counter[FrameGroup] = field(default_factory=Counter)
    """Frames that did not come to the loop: damaged, or beyond the base rate."""
    encoded: int = 0
    unanalyzed: int = 0
    """Coded, or left out by frame decimation, and skipped by perception, because stills or detection were behind."""
    encode_ns: int = 0
    paused_ns: int = 0
    """Total time for which a clip's clock stood still, because the next frame was not there in time."""
    awaited_ns: int = 0
    """The part of it for which the clip's file had to grow first."""
    newest_came_ns: int | None = None
    """When the source gave the newest frame; None before the first."""
    resumed_ns: int = 0
    """When the source was opened again."""
    last_index: int = -1
    first_capture_ns: int | None = None
    last_capture_ns: int = 0
    cpu: CpuMeter = field(default_factory=CpuMeter)
    _source_before: tuple[int, int] = (0, 0)
    _measured: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)
    """At the last measurement: frames captured, dropped as late, not analyzed; encoding and perception time."""

    @property
    def slow_ns(self) -> int:
        """By how much a clip is played longer than it is, because the machine is too slow."""
        return self.paused_ns - self.awaited_ns

    @property
    def captured(self) -> int:
        """Frames that came to the loop, including those for which it was too slow."""
        return self.groups.total()

    @property
    def dropped_cpu(self) -> int:
        """Frames dropped before encoding because the machine was behind."""
        return self.groups["processor"]

    def account(self, *, coded_fps: float, auto_fps: bool) -> FrameAccount:
        return FrameAccount(dict(self.groups + self.source_groups), coded_fps, auto_fps)

    def drop(self, group: FrameGroup, count: int = 1) -> None:
        """Count frames that were dropped before any decision on them."""
        if count:
            self.groups[group] += count

    def settle(
        self, decision: FrameDecision, *, coded: bool, taken: bool = True, has_viewer: bool = True
    ) -> None:
        """Count a frame on which ``decision`` was taken; once for each.

        ``coded``: it has a unit; ``taken``: it was sent or stored; ``has_viewer``: a program
        subscribes to the video.

        | decision | coded | taken | has_viewer | group |
        |---|---|---|---|---|
        | skip | | | | frame_rate |
        | hold | | | | the holder: budget, link, closer_look … |
        | code | no | | | encoder |
        | code, to the store | yes | no | | link |
        | code, to the link | yes | no | | budget |
        | code, to the store alone | yes | yes | | stored |
        | code, to the link | yes | yes | yes | sent |
        | code, to the link | yes | yes | no | nobody_listened |

        A probe of an outage goes to both, and counts as sent: no ground receives more frames than were sent.
        """
        group: FrameGroup = "sent" if has_viewer else "nobody_listened"
        if decision.action is Action.SKIP:
            group = "frame_rate"
        elif decision.action is Action.HOLD:
            group = decision.held_by
        elif not coded:
            group = "encoder"
        elif not taken:
            group = "link" if decision.to_store else "budget"
        elif decision.to_store and not decision.to_link:
            group = "stored"
        self.groups[group] += 1

    def begin(self, source: Source) -> None:
        """The flight begins: frames that the source left out before do not count."""
        self._source_before = (source.unreadable, source.passed_over)

    def note_source(self, source: Source) -> None:
        """Take over the source's counts of frames that it left out by itself."""
        unreadable, passed_over = self._source_before
        self.source_groups["unreadable"] = source.unreadable - unreadable
        self.source_groups["frame_rate"] = source.passed_over - passed_over

    @property
    def encode_ms(self) -> float:
        return self.encode_ns / max(1, self.encoded) / 1e6

    def note(self, frame: Frame, *, encode_ns: int) -> None:
        if self.first_capture_ns is None:
            self.first_capture_ns = frame.capture_ns
        self.last_index, self.last_capture_ns = frame.index, frame.capture_ns
        self.encoded += 1
        self.encode_ns += encode_ns

    def measure_cpu(self, *, perception_ns: int) -> None:
        """Called about once a second: the cost of all frames, estimated from those that were not left out."""
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
        """Capture time from the first frame sent to the last, plus one frame's length."""
        if self.first_capture_ns is None:
            return 0.0
        return (self.last_capture_ns - self.first_capture_ns) / SECOND_NS + 1 / fps
