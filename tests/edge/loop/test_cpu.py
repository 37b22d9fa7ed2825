"""Processor time: what every frame would take, and what others leave."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections import Counter

import pytest

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
