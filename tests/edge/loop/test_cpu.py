"""Processor time: what every frame would take, and what others leave."""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from hvt_edge.loop import counts
from hvt_edge.loop.counts import CpuMeter, FrameCounts


def burn(seconds: float) -> None:
    """One core."""
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass


@dataclass
class Machine:
    """Processor 0, the only one, as it is told to this process; time goes by where a test says so."""

    stat: Path
    wall_s: float = 0.0
    own_s: float = 0.0
    others_s: float = 0.0

    def passes(self, seconds: float, *, own_s: float, others_s: float = 0.0) -> None:
        """This process takes so much of it, and others so much."""
        self.wall_s += seconds
        self.own_s += own_s
        self.others_s += others_s
        hertz = os.sysconf("SC_CLK_TCK")
        own, others = round(self.own_s * hertz), round(self.others_s * hertz)
        self.stat.write_text(
            f"cpu 9 9 9 9 9 9 9 9 0 0\ncpu0 {own} 0 0 {7 * hertz} {8 * hertz} 0 0 {others} 0 0\n"
        )


@pytest.fixture
def machine(tmp_path, monkeypatch) -> Machine:
    """Of `counts`."""
    made = Machine(tmp_path / "stat")
    made.passes(0.0, own_s=0.0)
    clocks = SimpleNamespace(monotonic=lambda: made.wall_s, process_time=lambda: made.own_s)
    for name, part in {"STAT": made.stat, "time": clocks, "usable_cores": lambda: {0}}.items():
        monkeypatch.setattr(counts, name, part)
    return made


def test_what_was_left_out_counts_as_needed(machine):
    """The summary would say that there was time enough, after it dropped half of the frames."""
    meter = CpuMeter()
    machine.passes(1.0, own_s=0.4)
    meter.measure(scale=3.0, short=True)
    assert (meter.now.needed, meter.now.taken) == pytest.approx((1.2, 0.4))
    short = meter.short
    assert short == meter.now
    machine.passes(1.0, own_s=0.2)
    meter.measure(scale=1.0, short=False)
    assert meter.now.needed == pytest.approx(0.2)
    assert meter.short == short, "only times of want count for the summary"


def test_a_core_that_another_process_takes_is_not_free(machine):
    """The summary would call cores free that the autopilot uses."""
    meter = CpuMeter()
    machine.passes(2.0, own_s=0.3, others_s=1.5)
    meter.measure(scale=1.0, short=True)
    assert meter.now.free == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("groups", "files", "processors"),
    [
        ("0::/", {"cpu.max": "50000 100000\n"}, 0.5),
        ("0::/a.slice/x", {"a.slice/x/cpu.max": "max 100000", "a.slice/cpu.max": "30000 100000"}, 0.3),
        (
            "1:cpu:/docker/ab\n0::/docker/ab",
            {"cpu/cpu.cfs_quota_us": "25000", "cpu/cpu.cfs_period_us": "100000"},
            0.25,
        ),
        (
            "4:cpu,cpuacct:/",
            {"cpu,cpuacct/cpu.cfs_quota_us": "-1\n", "cpu,cpuacct/cpu.cfs_period_us": "100000\n"},
            None,
        ),
        ("0::/", {"cpu.max": "max 100000"}, None),
        ("4:memory:/x", {"cpu.max": "1000 100000"}, None),
        (None, {}, None),
    ],
)
def test_a_containers_limit_is_known(tmp_path, monkeypatch, groups, files, processors):
    """Perception would take half of the host's processors, and video would have nothing left of half a one."""
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    if groups is not None:
        (tmp_path / "groups").write_text(groups)
    given = counts.quota(tmp_path / "groups", tmp_path)
    assert given == (processors or math.inf)
    monkeypatch.setattr(counts, "quota", lambda: given)
    every = len(os.sched_getaffinity(0))
    assert counts.processors() == (processors or every)
    meter = CpuMeter()
    burn(0.12)
    meter.measure(scale=1.0, short=False)
    assert meter.now.free <= (processors or every)


def test_video_and_perception_count_by_what_each_took(machine):
    """A detector that skipped half of its frames would count as if it had seen all."""
    came = Counter({"sent": 100})
    skipping = FrameCounts(groups=came, unanalyzed=50, encode_ns=1_000)
    whole = FrameCounts(groups=came, encode_ns=1_000)
    machine.passes(1.0, own_s=0.3)
    skipping.measure_cpu(perception_ns=3_000)
    whole.measure_cpu(perception_ns=3_000)
    assert skipping.cpu.now.needed / whole.cpu.now.needed == pytest.approx((1 + 2 * 3) / 4)
    assert skipping.cpu.short.needed > 0
    assert whole.cpu.short.needed == 0
