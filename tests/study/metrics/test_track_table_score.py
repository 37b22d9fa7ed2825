"""Scores of tracks against ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_ground.events import Notice, Overlay
from hvt_ground.sinks.event_tables import TrackTable
from hvt_study.datasets.labels import FrameLabels
from hvt_study.metrics.judged import FrameView
from hvt_study.metrics.track_table_score import read_tracks, score

AREA_PX = 1280 * 720


def objects(*rows: tuple[float, float, float, float, str]) -> FrameLabels:
    return FrameLabels.plain([row[:4] for row in rows], [row[4] for row in rows])


def shown(*rows: tuple[float, float, float, float, str]) -> FrameView:
    return FrameView.plain([row[:4] for row in rows], [row[4] for row in rows])


def test_known_answer() -> None:
    """A wrong formula here would make every comparison of methods worthless."""
    truth = {1: objects((0, 0, 10, 10, "car"), (100, 0, 200, 100, "van"), (300, 0, 310, 10, "car"))}
    tracks = {1: shown((1, 0, 11, 10, "car"), (100, 0, 200, 100, "car"), (600, 0, 610, 10, "bus"))}
    result = score(tracks, truth, frame_area_px=AREA_PX)
    assert result.counts.labels == 3
    assert result.recall == pytest.approx(2 / 3)
    assert result.counts.top1_found == pytest.approx(1 / 2)
    assert result.by_size["small"].top1_found == 1.0
    assert result.counts.top1_all == pytest.approx(1 / 3)
    # car: 1 hit of 2 objects and 2 claims; van: no hit.
    assert result.macro_f1_all == pytest.approx((2 * 1 / (2 + 2) + 0) / 2)


def test_a_track_counts_for_one_object_only() -> None:
    """One large box over two neighbours must not find both."""
    truth = {1: objects((0, 0, 10, 10, "car"), (0, 1, 10, 11, "car"))}
    tracks = {1: shown((0, 0, 10, 10, "car"))}
    assert score(tracks, truth, frame_area_px=AREA_PX).recall == 0.5


def test_frames_without_tracks_count_as_missed() -> None:
    """A ground that shows nothing for a while must lose points for it."""
    truth = {frame: objects((0, 0, 10, 10, "car")) for frame in (1, 2, 3, 4)}
    tracks = {1: shown((0, 0, 10, 10, "car"))}
    assert score(tracks, truth, frame_area_px=AREA_PX).recall == 0.25


def overlay(
    frame_index: int, boxes: list[tuple[float, float, float, float]], classes: tuple[str, ...]
) -> Overlay:
    count = len(boxes)
    return Overlay(
        frame_index=frame_index,
        capture_ns=frame_index * 10**9,
        track_ids=np.arange(1, count + 1),
        boxes_base_px=np.array(boxes, np.float32).reshape(-1, 4),
        base_classes=("moving",) * count,
        classes=classes,
        confidences=np.full(count, 0.5, np.float32),
        refined=np.ones(count, bool),
    )


def test_the_table_of_the_ground_reads_back(tmp_path: Path) -> None:
    """What hvt-ground --tracks writes is what the demo's table is made of."""
    path = tmp_path / "tracks.csv"
    table = TrackTable(path)
    table.log(overlay(0, [(1, 2, 11, 22), (5, 5, 9, 9)], ("car", "van")))
    table.log(Notice(0, 0, "info", "not a track"))
    table.log(overlay(3, [], ()))
    table.log(overlay(4, [(0, 0, 4, 4)], ("bus",)))
    table.close()
    read = read_tracks(path)
    assert set(read) == {1, 5}
    assert read[1].class_names == ("car", "van")
    np.testing.assert_allclose(read[1].boxes_xyxy_px[0], (1, 2, 11, 22))


def test_wrong_files_are_one_sentence(tmp_path: Path) -> None:
    """A table of something else is named, not counted as no tracks."""
    junk = tmp_path / "junk.csv"
    for text in (
        "",
        "frame,x,y,w,h,class\n1,nan,2,3,4,car\n",
        'frame,x,y,w,h,class\n1,1,2,3,4,"' + "car" * 50_000,  # a quotation mark that nothing closes
        "a,b\n1,2\n",
    ):
        junk.write_text(text)
        with pytest.raises(UserError, match=r"junk\.csv is not a table of tracks"):
            read_tracks(junk)
    with pytest.raises(UserError, match=r"none\.csv cannot be read \(No such file or directory\)"):
        read_tracks(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("frames", "shown"),
    [
        ([], set()),
        ([*range(1, 24, 2)], {*range(1, 25)}),
        ([1, 2, 3, 6, 7, 8, 9, 10, 11, 12, 13, 14], {1, 2, 3, 6, 7, 8, 9, 10, 11, 12, 13, 14}),
        ([1, 5], {1, 5}),
    ],
)
def test_between_two_coded_frames_the_list_stands(tmp_path, frames, shown):
    """An edge that codes each second frame would be said to know nothing half of the time."""
    table = tmp_path / "tracks.csv"
    table.write_text("frame,x,y,w,h,class\n" + "".join(f"{one},{one},2,3,4,car\n" for one in frames))
    tracks = read_tracks(table)
    assert set(tracks) == shown
    assert all(tracks[one].boxes_xyxy_px[0, 0] == max(f for f in frames if f <= one) for one in shown)
