"""Frames that wait for perception: bounded, newest first to stay, and no access unit is missing."""

import threading
import time

import numpy as np

from hvt_common.values import AccessUnit, Frame
from hvt_edge.perception.frame_queue import FrameQueue, SkippedUnits


def unit(index: int, *, keyframe: bool = False, size: int = 1_000) -> AccessUnit:
    """An access unit."""
    return AccessUnit(index, index, bytes(size), keyframe)


def test_what_was_skipped_is_bounded_and_decoding_goes_on_at_a_keyframe():
    """A link that is full for minutes would fill the memory; or the decoder would be given what it cannot use."""
    skipped = SkippedUnits()
    skipped.add(unit(1))
    skipped.add(None)
    assert skipped.take(None) == (None, ()), "a frame that is not coded needs nothing yet"
    assert skipped.take(unit(3)) == (unit(3), (unit(1),))
    assert skipped.take(unit(4)) == (unit(4), ())
    for index in range(5, 10):
        skipped.add(unit(index, size=2**19))
    assert skipped.take(unit(10)) == (None, ())
    skipped.add(unit(11, keyframe=True))
    skipped.add(unit(12))
    assert skipped.take(unit(13)) == (unit(13), (unit(11, keyframe=True), unit(12)))
    skipped.add(unit(14))
    assert skipped.take(unit(15, keyframe=True)) == (unit(15, keyframe=True), ())


def frame(index: int) -> Frame:
    """A frame of 48 bytes in each of its two pictures."""
    picture = np.zeros((4, 4, 3), np.uint8)
    return Frame(index, index, picture, picture)


def test_the_newest_frame_has_a_place_and_the_oldest_makes_way():
    """Stills would be chosen from what was seen a second ago, while the camera has moved on."""
    queue = FrameQueue(length=16, max_bytes=3 * 96)
    left_out = [queue.put(frame(index), unit(index, keyframe=index == 0)) for index in range(5)]
    assert left_out == [0, 0, 0, 1, 1]
    taken, taken_unit, skipped = queue.get(timeout_s=0)
    assert (taken.index, taken_unit.frame_index) == (2, 2)
    assert [one.frame_index for one in skipped] == [0, 1], "the decoder is given them first"
    assert [queue.get(timeout_s=0)[0].index for _ in range(2)] == [3, 4]
    assert queue.get(timeout_s=0) is None


def test_two_frames_have_a_place_however_large():
    """An 8K camera would never be analyzed."""
    queue = FrameQueue(length=16, max_bytes=1)
    assert [queue.put(frame(index), None) for index in range(3)] == [0, 0, 1]


def test_getting_waits_for_a_frame_and_ends_with_the_queue():
    """Perception would burn a core while it waits, or hold up the end of the flight."""
    queue = FrameQueue(length=4, max_bytes=10_000)
    threading.Timer(0.05, queue.put, (frame(7), None)).start()
    assert queue.get(timeout_s=30)[0].index == 7
    threading.Timer(0.05, queue.close).start()
    began_s = time.monotonic()
    assert queue.get(timeout_s=30) is None
    assert time.monotonic() - began_s < 20
    assert queue.ended
