"""The order in which perception takes what has come, in real time."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hvt_common.protocol.messages import RoiHeader
from hvt_common.values import Tracks
from hvt_ground.perception.pipeline import DecodedFrame
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.worker import LockstepWorker
from programs.processes import eventually
from rigs.flight import Flight, patient_worker


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(3)


def picture(index: int) -> DecodedFrame:
    return DecodedFrame(index, index, index, np.zeros((8, 8, 3), np.uint8))


def still(flight: Flight, index: int, sequence: int) -> ReceivedStill:
    item = flight.still(index, sequence)
    return ReceivedStill(RoiHeader.parse(item.attachment, item.payload), item.payload)


class Rig:
    """A worker that notes what it does, and waits in the first of it until it may go on.

    ``at`` are pictures during which something else happens.
    """

    def __init__(self, at: dict[int, Callable[[], None]] | None = None) -> None:
        self.done: list[tuple[str, Any]] = []
        self.begun, self.go_on = threading.Event(), threading.Event()
        self.now_s = 0.0
        self.waits: dict[int, bool] = {}
        """Pictures, and whether their detection was waited for."""
        self._at = at or {}
        self.worker = patient_worker(
            self._analyze,
            lambda tracks, _at_ns: self._note("step", tracks.frame_index),
            lambda stills: self._note("stills", [one.header.sequence for one in stills]),
            clock=lambda: self.now_s,
        )

    def _analyze(self, one: DecodedFrame, hurry: bool, news: threading.Event | None) -> None:  # noqa: FBT001
        assert news is not None
        self.waits[one.frame_index] = not news.is_set()
        self._note("hurry" if hurry else "picture", one.frame_index)
        self._at.get(one.frame_index, lambda: None)()

    def _note(self, what: str, which: object) -> None:
        self.done.append((what, which))
        self.begun.set()
        assert self.go_on.wait(timeout=60)

    def pictures(self, *indices: int) -> None:
        """They come while the first of them is looked at."""
        for index in indices:
            self.worker.picture(picture(index))
            assert self.begun.wait(timeout=60)
            self.worker.raise_error()

    def finish(self) -> list[tuple[str, Any]]:
        self.go_on.set()
        eventually(lambda: self.worker.idle, what="all is done")
        assert self.worker.close()
        self.worker.raise_error()
        return self.done


def test_pictures_come_between_the_stills_of_two_frames(flight):
    """A handful of stills, a detection each, would hold up the boxes of a second of video."""
    rig = Rig()
    for sequence, index in enumerate((0, 0, 1, 2)):
        rig.worker.still(still(flight, index, sequence))
    assert rig.begun.wait(timeout=60)
    rig.pictures(7)
    rest = rig.finish()
    assert [one for _, which in rest if isinstance(which, list) for one in which] == [0, 1, 2, 3]
    assert rest[1] == ("picture", 7), "the first frame's are in hand when it comes, the others wait for it"


def test_a_report_of_tracks_lets_the_pictures_before_it_go_first():
    """The boxes of a former picture stood on all that came while the detector ran."""
    rig = Rig()
    rig.pictures(1)
    for index in (2, 3):
        rig.worker.step(Tracks.none(index), index)
        rig.pictures(index)
    rig.worker.step(Tracks.none(4), 4)
    order = [which if kind == "step" else -which for kind, which in rig.finish()]  # pictures count below 0
    assert order[-1] == 4
    assert all(order.index(-index) < order.index(index) for index in (2, 3))


def test_pictures_that_waited_for_long_are_passed_over():
    """A ground of too many edges would show every one of them ever later, and hold them all until it could look."""
    rig = Rig()
    rig.pictures(0, 1, 2, 3)
    rig.now_s += 0.7
    rig.pictures(4)
    assert rig.worker.untracked == 3, "at once"
    assert rig.finish() == [("picture", 0), ("picture", 4)]


def test_pictures_may_be_passed_over_while_one_before_them_is_looked_at():
    """On a busy machine it ended the session with an error, and its recording broke in two."""

    def later() -> None:
        rig.now_s += 0.7
        rig.pictures(4)

    rig = Rig({1: later})
    rig.pictures(0, 1, 2, 3)
    assert rig.finish() == [("picture", 0), ("hurry", 1), ("picture", 4)]
    assert rig.worker.untracked == 2


def test_detection_is_for_the_newest_picture():
    """Boxes would be shown late, one detection after the other, on a machine that is a little behind."""
    rig = Rig()
    rig.pictures(0, 1, 2, 3)
    assert rig.finish() == [("picture", 0), ("hurry", 1), ("hurry", 2), ("picture", 3)]


def test_a_still_that_comes_while_an_older_picture_is_tracked_waits_for_no_detection(flight):
    """It waited until the detector was done with the next picture, or for good where that hangs."""
    rig = Rig({1: lambda: rig.worker.still(still(flight, 1, 0))})
    rig.pictures(0, 1, 2)
    rig.finish()
    assert not rig.waits[2]


@pytest.mark.parametrize("slow", [False, True])
def test_in_lockstep_a_pose_counts_from_the_same_frame_on_however_long_perception_takes(slow):
    """The same flight received again would place the same tracks elsewhere."""
    done: list[Any] = []

    def analyze(one: DecodedFrame, _hurry: object, _newer: object) -> None:
        time.sleep(0.03 * slow)
        done.append(one.frame_index)

    worker = LockstepWorker(analyze, lambda _tracks, _at_ns: None, lambda _stills: None, name="x")
    for index in range(6):
        worker.picture(picture(index))
        if index in (1, 3):
            worker.pose(lambda: done.append("pose"), index)
        time.sleep(0.03 * (not slow))
    worker.close()
    assert done == [0, 1, 2, "pose", 3, 4, "pose", 5]


def test_in_lockstep_an_analysis_that_fails_is_raised_at_once():
    """An edge of few frames a second waits for its ground, and would end as if that had gone."""
    worker = LockstepWorker(lambda *_: 1 / 0, lambda *_: None, lambda _: None, name="x")
    worker.picture(picture(0))
    eventually(lambda: worker.idle)
    with pytest.raises(ZeroDivisionError):
        worker.raise_error()
    worker.raise_error()  # once
    worker.close()


def test_who_brings_pictures_never_waits_for_the_one_in_hand():
    """With a large model the ground would decode ever later: 250 waits of 0.3 s outlast the patience of the rig."""
    rig = Rig()
    rig.pictures(*range(251))
    assert rig.worker.untracked == 238
    assert [which for _, which in rig.finish()] == [0, *range(239, 251)], "the newest, whatever is left out"


def test_large_pictures_that_wait_have_a_bound_in_bytes():
    """A picture of 8192x4352 costs an edge a hundred bytes, and the ground 53 MB: twelve would fill it."""
    rig = Rig()
    large = np.broadcast_to(np.uint8(0), (4352, 8192, 1))
    rig.pictures(0)
    for index in range(1, 6):
        rig.worker.picture(DecodedFrame(index, index, index, large))
    rig.pictures(6, 7, 8)
    assert rig.worker.untracked == 4
    assert [which for _, which in rig.finish()] == [0, 5, 6, 7, 8]


def test_early_stills_have_a_bound_in_bytes(flight):
    """In lockstep stills wait for their frame: 256 of the largest would be a gigabyte."""
    worker = LockstepWorker(lambda *_: None, lambda *_: None, lambda _: None, name="x")
    early = replace(still(flight, 2, 0), data=bytes(2**22))
    for _ in range(12):
        worker.still(early)
    assert worker.dropped["overflow"] == 4
    worker.close()
    assert worker.dropped["ended"] == 8
