"""Sessions that share a detector get it alike, and none waits for it for long."""

from __future__ import annotations

import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from hvt_ground.config import GroundConfig, check
from hvt_ground.perception.models import Turns
from hvt_ground.perception.pipeline import DecodedFrame
from hvt_ground.wiring import Models
from hvt_ground.wiring.perception import make_pipeline
from rigs.flight import Flight, NothingSeen


def flown(fps: dict[str, float], *, detect_s: float, lasts_s: float) -> Counter[str]:
    """How often each edge detected: all ask with each of their pictures, for as long as half the time to the next."""
    turns, had, detecting = Turns(), Counter[str](), threading.Lock()

    def fly(name: str) -> None:
        time.sleep(list(fps).index(name) / len(fps) / fps[name])  # cameras do not look in step
        end_s = time.monotonic() + lasts_s
        while time.monotonic() < end_s:
            began_s = time.monotonic()
            if turns.take(name, within_s=0.5 / fps[name]):
                assert detecting.acquire(blocking=False), "two at once"
                time.sleep(detect_s)
                had[name] += 1
                detecting.release()
                turns.release()
            time.sleep(max(0.0, began_s + 1 / fps[name] - time.monotonic()))

    threads = [threading.Thread(target=fly, args=(name,)) for name in fps]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    return had


def test_one_alone_has_every_turn():
    """A single flight would be seen worse for the sake of others that are not there."""
    turns = Turns()
    for _ in range(100):
        assert turns.take("a", within_s=0.0)
        turns.release()


@pytest.mark.parametrize("count", [2, 8, 16])
def test_a_noisy_edge_starves_no_other(count):
    """An edge of 100 frames a second would take the detector from those of 10."""
    fps = {"noisy": 100.0} | {f"calm-{number}": 10.0 for number in range(count - 1)}
    had = flown(fps, detect_s=0.025, lasts_s=3.0)
    calm = [had[name] for name in fps if name != "noisy"]
    most = max(had.values())
    assert min(calm) >= 0.25 * min(most, 3 * 10), "on a busy machine a picture may come late"


def test_nobody_waits_for_longer_than_it_said():
    """The pictures of one edge would pile up behind another's detection."""
    turns = Turns()
    assert turns.take("a", within_s=0.0)
    began_s = time.monotonic()
    assert not turns.take("b", within_s=0.05)
    assert time.monotonic() - began_s >= 0.05
    turns.release()
    assert turns.take("b", within_s=0.0)
    turns.release()


def test_of_those_that_wait_the_one_with_fewest_turns_is_next():
    """Who asks most often would get most."""
    turns, order = Turns(), []
    assert turns.take("seldom", within_s=0.0)
    turns.release()
    for _ in range(3):
        assert turns.take("often", within_s=0.0)
        turns.release()
    assert turns.take("now", within_s=0.0)

    def waits(name: str) -> None:
        assert turns.take(name, within_s=20.0)
        order.append(name)
        turns.release()

    threads = [threading.Thread(target=waits, args=(name,)) for name in ("often", "seldom")]
    for one in threads:
        one.start()
        time.sleep(0.3)
    turns.release()
    for one in threads:
        one.join()
    assert order == ["seldom", "often"]


def test_who_is_patient_waits_and_takes_no_turn_of_others():
    """An edge that says lockstep would have the detector whenever it likes, and others would have none."""
    turns = Turns()
    assert turns.take("a", within_s=0.0)
    with ThreadPoolExecutor(1) as other:
        patient = other.submit(turns.take, "b", within_s=None)
        assert not patient.done()
        turns.release()
        assert patient.result(timeout=20)
    assert not turns.take("a", within_s=0.0)
    turns.release()


def test_lockstep_takes_turns_with_all_others():
    """It is no way around them."""
    config = check(GroundConfig(detector="motion", classifier="none"))
    models = Models(config)
    waits = []
    models.turns.take = lambda _who, *, within_s: waits.append(within_s) or True
    for pace in ("realtime", "lockstep"):
        info = replace(Flight(1).info(), pace=pace)
        pipeline = make_pipeline(config, models, info=info, emit=lambda _: None)
        pipeline.analyze(DecodedFrame(0, 0, 0, np.zeros((192, 320, 3), np.uint8)), hurry=False)
    assert waits == [pytest.approx(0.5 / 15), None]


@pytest.mark.parametrize(
    ("tiles", "pace", "runs"),
    [("auto", "realtime", 2), ("auto", "lockstep", 1), ("search", "lockstep", 2), ("off", "realtime", 1)],
)
def test_the_scale_is_found_in_real_time_and_where_it_is_wanted(tiles, pace, runs):
    """Objects of a few pixels would have no box, or a study that is repeated other figures."""
    models, network = Models(check(GroundConfig(classifier="none"))), NothingSeen()
    models.take = lambda: (network, None)
    config, info = check(GroundConfig(classifier="none", tiles=tiles)), replace(Flight(1).info(), pace=pace)
    pipeline = make_pipeline(config, models, info=info, emit=lambda _: None)
    pipeline.analyze(DecodedFrame(0, 0, 0, np.zeros((192, 320, 3), np.uint8)), hurry=False)
    assert network.runs == runs
