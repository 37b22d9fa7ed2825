"""Processor time: what every frame would take, and what others leave."""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections import Counter

import pytest

from hvt_edge.loop import counts
from hvt_edge.loop.counts import CpuMeter, FrameCounts


def burn(seconds: float) -> None:
    """One core."""
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass


def test_what_was_left_out_counts_as_needed():
    """The summary would say that there was time enough, after it dropped half of the frames."""
    began_s, own_s = time.monotonic(), time.process_time()
    meter = CpuMeter()
    burn(0.4)
    meter.measure(scale=3.0, short=True)
    took = (time.process_time() - own_s) / (time.monotonic() - began_s)
    assert meter.now.needed == pytest.approx(3 * took, rel=0.2)
    short = meter.short
    assert short == meter.now
    burn(0.2)
    meter.measure(scale=1.0, short=False)
    assert meter.short == short, "only times of want count for the summary"


def test_a_core_that_another_process_takes_is_not_free():
    """The summary would call cores free that the autopilot uses."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        other = multiprocessing.get_context("fork").Process(target=burn, args=(30,), daemon=True)
        other.start()
        meter = CpuMeter()
        time.sleep(1.0)
        meter.measure(scale=1.0, short=True)
        other.kill()  # a handler of SIGTERM that an earlier test left here would let it burn to its end
        other.join()
    finally:
        os.sched_setaffinity(0, cores)
    assert meter.now.free < 0.3


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


def test_video_and_perception_count_by_what_each_took():
    """A detector that skipped half of its frames would count as if it had seen all."""
    came = Counter({"sent": 100})
    skipping = FrameCounts(groups=came, unanalyzed=50, encode_ns=1_000)
    whole = FrameCounts(groups=came, encode_ns=1_000)
    burn(0.3)
    skipping.measure_cpu(perception_ns=3_000)
    whole.measure_cpu(perception_ns=3_000)
    assert skipping.cpu.now.needed / whole.cpu.now.needed == pytest.approx((1 + 2 * 3) / 4, rel=0.05)
    assert skipping.cpu.short.needed > 0
    assert whole.cpu.short.needed == 0
