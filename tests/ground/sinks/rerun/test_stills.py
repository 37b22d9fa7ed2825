"""Stills and origins in the recording: where a still is shown, for how long, and who knows of a track."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hvt_ground.events import Event, Overlay, Refinement, VideoSample
from hvt_ground.sinks.rerun.overlays import ORIGINS, REPORTED_MARK
from hvt_ground.sinks.rerun.still_places import FRESH_NS, PATCHES, Moved, Patches, Placement
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames
from programs.rrd import Recording, recorded
from rigs.examples import overlay, refinement

BOX = (100.0, 50.0, 140.0, 80.0)
START = (0.0, 0.0, 30.0, 30.0)


def cars(frame: int, boxes: Sequence[Any], ids: Sequence[int], **changes: Any) -> Overlay:
    values = {"capture_ns": START_NS + frame * STEP_NS, "track_ids": np.array(ids, np.int64)}
    return overlay(frame, boxes, **(values | changes))


def still_of(frame: int, sequence: int, box: tuple[float, ...], **changes: object) -> Refinement:
    """A still of the object in ``box`` with ten pixels around it, twice as fine as the base."""
    width, height = round(2 * (box[2] - box[0] + 20)), round(2 * (box[3] - box[1] + 20))
    picture = np.full((height, width, 3), (40, 200, 40), np.uint8)
    values = {
        "frame_index": frame,
        "capture_ns": START_NS + frame * STEP_NS,
        "still_sequence": sequence,
        "box_base_px": box,
        "still": cv2.imencode(".jpg", picture)[1].tobytes(),
        "base_crop_bgr": picture[::2, ::2],
        "class_after": "van",
        "crop_base_px": (box[0] - 10, box[1] - 10, box[2] + 10, box[3] + 10),
    }
    return refinement(**(values | changes))


def read_back(folder: Path, *events: Event) -> Recording:
    return Recording(recorded(folder / "a.rrd", events))


def test_a_still_lies_on_the_enhanced_picture_and_goes_with_its_object(tmp_path: Path) -> None:
    """A sharp car beside its own blurred picture, or on an empty road, would be worse than none."""
    still, events = still_of(2, 0, BOX), []
    for frame in range(60):
        # Still at first; from frame 20 on the object moves, and from 50 on its track is gone.
        shift = np.array([1, 0, 1, 0]) * max(0, frame - 20) * 4.0
        there = {1: BOX + shift, 2: np.array(BOX) + 100} if frame < 50 else {2: np.array(BOX) + 100}
        events.append(cars(frame, list(there.values()), list(there)))
        events += {2: [still], 30: [still_of(30, 1, (120.0, 50.0, 160.0, 80.0))]}.get(frame, [])
    read = read_back(tmp_path, *events)
    assert read.patches(1) == {}
    assert read.patches(2) == read.patches(19) == {0: (90, 40, 0.5, still.still)}
    # It rides along for a while; the second still is of frame 25, and put where the object is now.
    for frame, x in ((22, 98), (30, 130), (36, 154)):
        assert read.patches(frame)[0][:2] == pytest.approx((x, 40), abs=1)
    assert read.patches(50) == {}


def test_the_still_of_a_moving_object_goes_stale() -> None:
    """After seconds of driving the picture of a car shows another turn, another light, another street."""
    board = Patches()
    board.move(cars(0, [START], [1]))
    assert board.put(still_of(0, 0, START), size=(100, 100)) == Moved(0, Placement(-10, -10, 0.5))
    gone = [f for f in range(1, 90) if Moved(0, None) in board.move(cars(f, [np.array(START) + f], [1]))]
    assert gone == [math.ceil(FRESH_NS / STEP_NS)]
    for changes in ({"track_id": 2}, {"crop_base_px": None}):
        assert board.put(still_of(0, 0, START, **changes), size=(100, 100)) is None


def test_the_enhanced_picture_holds_the_newest_stills() -> None:
    """A pool that fills up once and for all would show the oldest stills for ever."""
    board = Patches()
    boxes = [(40.0 * i, 0.0, 40.0 * i + 30, 30.0) for i in range(PATCHES + 5)]
    board.move(cars(0, boxes, range(len(boxes))))

    def slot(frame: int, track: int) -> int:
        return board.put(still_of(frame, frame, boxes[track], track_id=track), size=(100, 100)).slot

    assert [slot(i, i) for i in range(len(boxes))] == [*range(PATCHES), *range(5)]
    assert slot(40, 7) == 7, "a track has one patch"


def test_a_still_of_several_objects_is_written_once(tmp_path: Path) -> None:
    """The recording would grow with every object that shares a still."""
    read = read_back(
        tmp_path, cars(0, [BOX], [1]), *(still_of(0, 3, BOX, track_id=track) for track in (1, 2))
    )
    assert (len(read.events()), len(read.stills())) == (2, 1)


def test_a_still_that_no_viewer_reads_is_shown_by_its_pixels(tmp_path: Path) -> None:
    """With residual stills gallery and enhanced picture would stay empty."""
    pixels = np.full((60, 80, 3), (10, 20, 200), np.uint8)
    still = still_of(0, 0, BOX, still=b"\0" * 200, media_type="application/x-residual", still_bgr=pixels)
    read = read_back(
        tmp_path, still, replace(still, still_sequence=1, still_bgr=None)
    )  # nothing without pixels
    ((_, data),) = read.stills()
    assert np.abs(cv2.imdecode(np.frombuffer(data, np.uint8), 1).astype(int) - pixels).max() < 12


def test_what_the_base_does_not_show_is_drawn_otherwise(tmp_path: Path) -> None:
    """The operator would trust a box that nothing in the picture supports."""
    boxes = [(40.0 * i, 20, 40.0 * i + 30, 50) for i in range(5)]
    origins = ("base", "edge", "edge+base", "still", "edge")
    refined, ids = np.array([True, False, False, False, True]), range(1, 6)
    told = cars(1, boxes, ids, origins=origins, refined=refined)
    read = read_back(tmp_path, cars(0, boxes, ids), told, cars(2, boxes, ids))
    assert all(not box.reported and box.origin == 0 for box in read.boxes(0).values())
    now = read.boxes(1)
    shown = [(False, False), (True, False), (True, False), (False, True), (False, True)]
    assert [(box.reported, box.refined) for box in now.values()] == shown
    assert {track: ORIGINS[box.origin] for track, box in now.items()} == dict(enumerate(origins, 1))
    assert now[2].box_px == (40, 20, 70, 50)
    assert {box.label for box in now.values()} == {""}, "nothing was renamed"
    assert [box.reported for box in read.boxes(2).values()] == [False] * 5
    assert REPORTED_MARK in read.rows("/session", "TextDocument:text")[0][2][0]


def test_a_step_between_coded_frames_shows_its_boxes(tmp_path: Path) -> None:
    """With one coded frame in five the boxes would stand still with the picture."""
    units = coded(drawn_frames(11), kbps=300, keyint=1)
    events = [cars(frame, [(10.0 * frame, 0, 10.0 * frame + 30, 30)], [1]) for frame in range(15)]
    for frame in (10, 5, 0):
        events.insert(frame, VideoSample(frame, START_NS + frame * STEP_NS, *units[frame]))
    read = read_back(tmp_path, *events, cars(3, [START], [1]))  # late: what it says has been drawn over
    assert [frame for frame, _, _ in read.video()] == [0, 5, 10]
    assert [read.boxes(frame)[1].box_px[0] for frame in range(15)] == [10.0 * frame for frame in range(15)]
