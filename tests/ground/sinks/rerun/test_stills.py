"""Stills and origins in the recording: where a still is shown, for how long, and who knows of a track."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from hvt_ground.events import Overlay, Refinement, VideoSample
from hvt_ground.sinks.rerun.overlays import ORIGINS, REPORTED_MARK
from hvt_ground.sinks.rerun.recorder import Recorder
from hvt_ground.sinks.rerun.still_places import FRESH_NS, PATCHES, Moved, Patches, Placement
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames
from programs.rrd import Recording, settings
from rigs.examples import overlay, refinement


def _overlay(frame: int, boxes: Sequence[np.ndarray], ids: Sequence[int]) -> Overlay:
    """Cars."""
    return overlay(frame, boxes, capture_ns=START_NS + frame * STEP_NS, track_ids=np.array(ids, np.int64))


def _one_still(
    frame: int, sequence: int, box: tuple[float, float, float, float], **changes: object
) -> Refinement:
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


def test_a_still_lies_on_the_enhanced_picture_and_goes_with_its_object(tmp_path: Path) -> None:
    """A sharp car beside its own blurred picture, or on an empty road, would be worse than none."""
    path = tmp_path / "a.rrd"
    box = (100.0, 50.0, 140.0, 80.0)
    still = _one_still(2, 0, box)
    with Recorder(settings(path)) as recorder:
        for frame in range(60):
            # Still at first; from frame 20 on the object moves, and from 50 on its track is gone.
            shift = np.array([max(0, frame - 20) * 4.0, 0, max(0, frame - 20) * 4.0, 0])
            ids = [1, 2] if frame < 50 else [2]
            recorder.log(_overlay(frame, [np.array(box) + shift, np.array(box) + 100][-len(ids) :], ids))
            if frame == 2:
                recorder.log(still)
            if frame == 30:
                recorder.log(_one_still(30, 1, tuple(float(v) for v in np.add(box, [20, 0, 20, 0]))))
    read = Recording(path)
    assert read.patches(1) == {}
    assert read.patches(2) == read.patches(19) == {0: (90, 40, 0.5, still.still)}
    assert read.patches(22)[0][:2] == pytest.approx((98, 40), abs=1), "it rides along for a while"
    # The second still is of frame 25: it is put where the object is now.
    assert read.patches(30)[0][:2] == pytest.approx((130, 40), abs=1)
    assert read.patches(36)[0][:2] == pytest.approx((154, 40), abs=1)
    assert read.patches(50) == {}


def test_the_still_of_a_moving_object_goes_stale() -> None:
    """After seconds of driving the picture of a car shows another turn, another light, another street."""
    board = Patches()
    start = (0.0, 0.0, 30.0, 30.0)
    board.move(_overlay(0, [np.array(start)], [1]))
    assert board.put(_one_still(0, 0, start), size=(100, 100)) == Moved(0, Placement(-10, -10, 0.5))
    gone = [f for f in range(1, 90) if Moved(0, None) in board.move(_overlay(f, [np.array(start) + f], [1]))]
    assert gone == [math.ceil(FRESH_NS / STEP_NS)]
    assert board.put(_one_still(0, 0, start, track_id=2), size=(100, 100)) is None
    assert board.put(_one_still(0, 0, start, crop_base_px=None), size=(100, 100)) is None


def test_the_enhanced_picture_holds_the_newest_stills() -> None:
    """A pool that fills up once and for all would show the oldest stills for ever."""
    board = Patches()
    many = PATCHES + 5
    boxes = [np.array([40.0 * i, 0, 40.0 * i + 30, 30]) for i in range(many)]
    board.move(_overlay(0, boxes, list(range(many))))
    slots = []
    for i, box in enumerate(boxes):
        put = board.put(_one_still(i, i, tuple(box.tolist()), track_id=i), size=(100, 100))
        slots.append(put.slot)
    assert slots == [*range(PATCHES), *range(5)]
    again = board.put(_one_still(40, 40, tuple(boxes[7].tolist()), track_id=7), size=(100, 100))
    assert again.slot == 7, "a track has one patch"


def test_a_still_of_several_objects_is_written_once(tmp_path: Path) -> None:
    """The recording would grow with every object that shares a still."""
    path = tmp_path / "a.rrd"
    box = (100.0, 50.0, 140.0, 80.0)
    with Recorder(settings(path)) as recorder:
        recorder.log(_overlay(0, [np.array(box)], [1]))
        recorder.log(_one_still(0, 3, box))
        recorder.log(_one_still(0, 3, box, track_id=2))
    read = Recording(path)
    assert len(read.events()) == 2
    assert len(read.stills()) == 1


def test_a_still_that_no_viewer_reads_is_shown_by_its_pixels(tmp_path: Path) -> None:
    """With residual stills gallery and enhanced picture would stay empty."""
    path = tmp_path / "a.rrd"
    pixels = np.full((60, 80, 3), (10, 20, 200), np.uint8)
    still = _one_still(
        0, 0, (100.0, 50.0, 140.0, 80.0), still=b"\0" * 200, media_type="application/x-residual"
    )
    with Recorder(settings(path)) as recorder:
        recorder.log(dataclasses.replace(still, still_bgr=pixels))
        recorder.log(dataclasses.replace(still, still_sequence=1))  # and nothing where pixels are missing
    ((_, data),) = Recording(path).stills()
    assert np.abs(cv2.imdecode(np.frombuffer(data, np.uint8), 1).astype(int) - pixels).max() < 12


def test_what_the_base_does_not_show_is_drawn_otherwise(tmp_path: Path) -> None:
    """The operator would trust a box that nothing in the picture supports."""
    path = tmp_path / "a.rrd"
    boxes = [np.array([40.0 * i, 20, 40.0 * i + 30, 50]) for i in range(5)]
    origins = ("base", "edge", "edge+base", "still", "edge")
    with Recorder(settings(path)) as recorder:
        recorder.log(_overlay(0, boxes, [1, 2, 3, 4, 5]))
        recorder.log(
            dataclasses.replace(
                _overlay(1, boxes, [1, 2, 3, 4, 5]),
                origins=origins,
                refined=np.array([True, False, False, False, True]),
            )
        )
        recorder.log(_overlay(2, boxes, [1, 2, 3, 4, 5]))
    read = Recording(path)
    assert all(not box.reported and box.origin == 0 for box in read.boxes(0).values())
    assert [(box.reported, box.refined) for box in read.boxes(1).values()] == [
        (False, False),
        (True, False),
        (True, False),
        (False, True),
        (False, True),
    ]
    now = read.boxes(1)
    assert {track: ORIGINS[box.origin] for track, box in now.items()} == dict(enumerate(origins, 1))
    assert now[2].box_px == (40, 20, 70, 50)
    assert {box.label for box in now.values()} == {""}, "nothing was renamed"
    assert [box.reported for box in read.boxes(2).values()] == [False] * 5
    assert REPORTED_MARK in read.rows("/session", "TextDocument:text")[0][2][0]


def test_a_step_between_coded_frames_shows_its_boxes(tmp_path: Path) -> None:
    """With one coded frame in five the boxes would stand still with the picture."""
    units = coded(drawn_frames(11), kbps=300, keyint=1)
    path = tmp_path / "a.rrd"
    with Recorder(settings(path)) as recorder:
        for frame in range(0, 15, 5):
            recorder.log(VideoSample(frame, START_NS + frame * STEP_NS, *units[frame]))
            for frame_index in range(frame, frame + 5):
                recorder.log(
                    _overlay(
                        frame_index, [np.array([10.0 * frame_index, 0, 10.0 * frame_index + 30, 30])], [1]
                    )
                )
        recorder.log(_overlay(3, [np.array([0.0, 0, 30, 30])], [1]))  # late: what it says has been drawn over
    read = Recording(path)
    assert [frame for frame, _, _ in read.video()] == [0, 5, 10]
    assert [read.boxes(frame_index)[1].box_px[0] for frame_index in range(15)] == [
        10.0 * frame_index for frame_index in range(15)
    ]
