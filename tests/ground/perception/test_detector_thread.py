"""Sessions that share a detector get it alike, and one at a time."""

import gc
import os
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from hvt_common.values import Detections
from hvt_ground.config import GroundConfig, check
from hvt_ground.perception.models import DetectorThread
from hvt_ground.perception.pipeline import DecodedFrame
from hvt_ground.perception.session import SessionPerception
from hvt_ground.wiring import Models
from programs.processes import eventually
from rigs.flight import Flight, NothingSeen, patient_worker

PICTURE = np.zeros((192, 320, 3), np.uint8)


def test_who_asks_often_starves_no_other():
    """An edge of 100 frames a second would take the detector from those of 10, or have it beside them."""
    thread, order, go = DetectorThread(), [], threading.Event()

    def detect(name):
        def run(_image):
            assert go.wait(timeout=60)
            order.append((name, threading.current_thread().name))
            return Detections.none()

        return run

    begun = [thread.submit(PICTURE, detect(name)) for name in ("often", "seldom", "often")]
    go.set()
    begun[0].found.result(timeout=60)
    begun.append(thread.submit(PICTURE, detect("now")))
    for one in begun:
        one.found.result(timeout=60)
    assert order == [(name, "hvt-detector") for name in ("often", "seldom", "often", "now")]


def test_the_thread_ends_with_its_sessions():
    """A study of 5,000 flights, or a program that opens ground after ground, kept a thread of each."""

    class Session:
        def __init__(self):
            self.thread, self.ran_in = DetectorThread(), None
            self.thread.submit(PICTURE, self.detect).found.result(timeout=60)

        def detect(self, _image):
            self.ran_in = threading.current_thread()
            return Detections.none()

    ran_in = Session().ran_in
    gc.collect()
    ran_in.join(timeout=60)
    assert not ran_in.is_alive()


@pytest.mark.skipif(sys.platform != "linux", reason="only there threads have priorities")
def test_who_follows_tracks_goes_before_the_detector():
    """On two cores lists waited for the processor as long as for the detector: boxes came a second late."""
    nice = {}

    def note(name, result=None):
        nice[name] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        return result

    DetectorThread().submit(PICTURE, lambda _: note("detector", Detections.none())).found.result(timeout=60)
    worker = patient_worker(lambda *_: note("worker"), lambda *_: None, lambda _: None)
    worker.picture(DecodedFrame(0, 0, 0, PICTURE))
    worker.close()
    assert nice["worker"] < nice["detector"] or nice["worker"] == 19, "the tests themselves may give way"


def test_a_picture_that_nobody_wants_any_more_is_not_searched_and_an_error_ends_no_other():
    """A flight that ended would take the detector once more, and a broken picture all others' boxes."""
    thread, go, ran = DetectorThread(), threading.Event(), []

    def fails(_image):
        assert go.wait(timeout=60)
        raise OSError("broken")

    def runs(_image):
        ran.append(1)
        return Detections.none()

    first, gone, last = (thread.submit(PICTURE, detect) for detect in (fails, runs, runs))
    gone.found.cancel()
    go.set()
    last.found.result(timeout=60)
    assert isinstance(first.found.exception(), OSError)
    assert ran == [1]


@pytest.mark.parametrize(
    ("tiles", "pace", "runs"),
    [("auto", "realtime", 3), ("auto", "lockstep", 2), ("search", "lockstep", 3), ("off", "realtime", 2)],
)
def test_the_scale_is_found_in_real_time_and_where_it_is_wanted(tiles, pace, runs):
    """Objects of a few pixels would have no box, or a study that is repeated other figures."""
    models, network = Models(check(GroundConfig(classifier="none"))), NothingSeen()
    models.take = lambda: (network, None)
    config, info = check(GroundConfig(classifier="none", tiles=tiles)), replace(Flight(1).info(), pace=pace)
    pipeline = SessionPerception(config, models, info).pipeline(lambda _: None)
    for index in (0, 100):
        pipeline.analyze(DecodedFrame(index, 0, 0, PICTURE), hurry=False)
    assert network.runs == runs
    eventually(lambda: not models.loading, what="the models are loaded: no process ends meanwhile")
