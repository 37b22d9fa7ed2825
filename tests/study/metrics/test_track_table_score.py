"""Scores of tracks against ground truth."""

from dataclasses import replace

import numpy as np
import pytest

from hvt_archive.exports.tables import TrackTable
from hvt_common.errors import UserError
from hvt_ground.events import Notice, Overlay
from hvt_scene import Scene
from hvt_study.cli import main
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.metrics.judged import FrameView
from hvt_study.metrics.track_table_score import read_tracks, read_truth, score
from studies.layouts import write_mot

AREA_PX = 1280 * 720


def objects(*rows):
    return FrameLabels.plain([row[:4] for row in rows], [row[4] for row in rows])


def shown(*rows):
    return FrameView.plain([row[:4] for row in rows], [row[4] for row in rows])


def test_who_lists_a_hidden_object_is_neither_right_nor_wrong(tmp_path):
    """A ground that sees more than was judged would be scored worse for it."""
    lines = ["1,1,1,1,10,10,1,1,1.0", "1,2,51,1,20,20,1,1,0.2"]
    (tmp_path / "gt.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    truth, one_target = read_truth(tmp_path / "gt.txt", class_names=("car",))
    assert not one_target
    seen = (0.0, 0.0, 10.0, 10.0, "car")
    results = [
        score({1: shown(seen, *more)}, truth, frame_area_px=AREA_PX)
        for more in ((), ((50.0, 0.0, 70.0, 20.0, "car"),), ((200.0, 0.0, 220.0, 20.0, "car"),))
    ]
    assert [one.counts.labels for one in results] == [1, 1, 1]
    assert results[0].by_size["small"] == results[0].counts
    assert [one.false_per_frame for one in results] == [0, 0, 1]
    assert results[0].named_f1 == results[1].named_f1 == 1


@pytest.mark.parametrize(
    ("truth", "recall"),
    [
        # One large box over two neighbours must not find both.
        ({1: objects((0, 0, 10, 10, "car"), (0, 1, 10, 11, "car"))}, 0.5),
        # A ground that shows nothing for a while must lose points for it.
        ({frame: objects((0, 0, 10, 10, "car")) for frame in (1, 2, 3, 4)}, 0.25),
    ],
)
def test_what_is_not_found(truth, recall):
    """A list would be worth more than it shows."""
    tracks = {1: shown((0, 0, 10, 10, "car"))}
    assert score(tracks, truth, frame_area_px=AREA_PX).recall == recall


def overlay(frame_index, boxes, classes):
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


def test_the_table_of_the_ground_reads_back(tmp_path, caplog):
    """What hvt-ground --tracks writes is what hvt-study score reads."""
    path = tmp_path / "tracks.csv"
    table = TrackTable(path)
    table.log(overlay(0, [(1, 2, 11, 22), (5, 5, 9, 9)], ("car", "van")))
    table.log(Notice(0, 0, "info", "not a track"))
    table.log(overlay(3, [], ()))
    table.log(overlay(4, [(0, 0, 4, 4)], ("bus",)))
    table.log(replace(overlay(2, [(0, 0, 4, 4)], ("bus",)), stored=True))  # nobody knew it then
    table.close()
    read = read_tracks(path)
    assert "1 lines came late, after an outage, and are left out" in caplog.text
    assert set(read) == {1, 5}
    assert read[1].class_names == ("car", "van")
    np.testing.assert_allclose(read[1].boxes_xyxy_px[0], (1, 2, 11, 22))


def test_perfect_tracks_of_the_demo_score_one(tmp_path, capsys):
    """The whole way, from the scene's truth file to the printed table."""
    truth_path, tracks_path = tmp_path / "gt.txt", tmp_path / "perfect.csv"
    lines = ["1,1,11,11,50,30,1,1,1.000", "1,2,101,11,50,30,1,2,1.000", "2,1,13,11,50,30,1,1,0.900"]
    truth_path.write_text("\n".join([*lines, "2,2,9,9,9,9,1,3,0.1"]) + "\n")
    names = Scene.class_names
    table = TrackTable(tracks_path)
    table.log(overlay(0, [(10, 10, 60, 40), (100, 10, 150, 40)], (names[0], names[1])))
    table.log(overlay(1, [(12, 10, 62, 40)], (names[0],)))
    table.close()
    assert main(["score", f"ours={tracks_path}", "--truth", str(truth_path)]) == 0
    printed = capsys.readouterr().out
    assert "ours" in printed
    assert printed.count("1.000") >= 4
    assert "│ objects on all frames               │     3 │" in printed
    assert main(["score", str(tracks_path), "--truth", str(truth_path), "--size", "64x64"]) == 2
    assert (
        "gt.txt has 1 of 3 boxes outside its pictures of 64x64: both files are in" in capsys.readouterr().err
    )


def test_wrong_files_are_one_sentence(tmp_path, capsys):
    """A table of something else is named, not counted as no tracks."""
    junk = tmp_path / "junk.csv"
    for text, said in (
        ("", "it has no column x, y, w, h, class"),
        *(
            (f"frame,x,y,w,h,class\n1,{x},2,3,4,car\n", "line 2 has no frame, box or class")
            for x in ("nan", "1e300")
        ),
        ("x,y,w,h,class\n1,2,3,4,car\n", "line 2 has no frame"),
        ("frame,x,y,w,h,class\n1,1,2,3,4\n", "line 2 has no frame, box or class"),
        # A quotation mark that nothing closes.
        ('frame,x,y,w,h,class\n1,1,2,3,4,"' + "car" * 50_000, "field larger than field limit"),
        ("a,b\n1,2\n", "it has no column x"),
    ):
        junk.write_text(text)
        with pytest.raises(UserError, match=rf"junk\.csv is not a table of tracks .*\({said}"):
            read_tracks(junk)
    with pytest.raises(UserError, match=r"junk\.csv, line 1 is 'a,b'"):
        read_truth(junk, class_names=("car",))
    assert main(["score", str(junk), "--truth", str(junk)]) == 2
    assert "Traceback" not in capsys.readouterr().err


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


def scored(tmp_path, capsys, truth, *more):
    """Exit code, table and errors of a score of one perfect track against this truth."""
    (tmp_path / "gt.txt").write_bytes(truth)
    (tmp_path / "t.csv").write_bytes(b"\xef\xbb\xbfframe,x,y,w,h,class\n1,10,10,50,30,pedestrian\n")
    code = main(["score", str(tmp_path / "t.csv"), "--truth", str(tmp_path / "gt.txt"), *more])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_truth_without_classes_counts(tmp_path, capsys, caplog):
    """Ten columns with -1, as MOT15 and trackers write, gave 0 objects and a named F1 of 1."""
    code, table, _ = scored(tmp_path, capsys, b"1,1,10,10,50,30,1,-1,-1,-1\n1,2,200,10,50,30,1,-1,-1,-1\n")
    assert code == 0
    assert "│ objects on all frames               │     2 │" in table
    assert "│ found (recall at IoU 0.5)           │ 0.500 │" in table
    assert "name no class: all are pedestrian" in caplog.text
    code, table, _ = scored(tmp_path, capsys, b"1,1,10,10,50,30,1,-1,-1,-1\n", "--classes", "person")
    assert "│ class right, of those found (top-1) │ 0.000 │" in table


def test_of_one_target_nothing_is_said_to_be_false(tmp_path, capsys):
    """Every other car that the ground shows was a false object, and named F1 .1 where the target was always found."""
    for truth, whole in (
        (b"1,1,11,11,50,30,1,1,1\n", False),
        (b"1,1,11,11,50,30,1,1,1\n2,1,1,1,9,9,0,1,1\n", False),
        (b"1,1,11,11,50,30,1,1,1\n1,2,1,1,9,9,0,1,1\n", True),
        (b"1,0,11,11,50,30,1,1,1\n1,0,1,1,9,9,0,1,1\n", True),
    ):
        write_mot(tmp_path / "a", rows=truth.decode())
        assert open_dataset(f"mot:{tmp_path / 'a'}")[0].one_target != whole, "mot: and score go by one rule"
        code, table, _ = scored(tmp_path, capsys, truth, "--classes", "pedestrian")
        assert (code, "│ found (recall at IoU 0.5)           │ 1.000 │" in table) == (0, True)
        assert ("named F1" in table, "recall alone can be said" in table) == (whole, not whole)


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        # A perfect score would be reported of an empty file.
        *(
            (truth, "gt.txt has no object that counts")
            for truth in (b"", b"1,1,10,10,50,30,0,1,1\n", b"1,1,10,10,50,30,1,1,0.1\n")
        ),
        # A class that nobody named would be counted as another.
        (b"1,1,10,10,50,30,1,1,1\n1,1,10,10,50,30,1,0,1\n", "gt.txt, line 2 is"),
        (b"1,1,10,10,50,30,1,1,1\n1,1,10,10,50,30,1,0,1\n", "a class from 1 to"),
        # From an editor of Windows.
        *(("1,1,10,10,50,30,1,1,1\r\n".encode(encoding), "") for encoding in ("utf-8-sig", "utf-16")),
    ],
)
def test_truth_of_any_editor_is_read_and_what_says_nothing_is_refused(tmp_path, capsys, truth, said):
    """A file that went through an editor of Windows would be called no text."""
    code, table, err = scored(tmp_path, capsys, truth)
    assert (code, bool(table)) == ((2, False) if said else (0, True))
    assert said in err


def test_a_table_that_is_missing_and_a_class_without_a_name_are_said(tmp_path, capsys):
    """Every object would be of no class, and a missing file of another format."""
    tracks, truth = tmp_path / "t.csv", tmp_path / "gt.txt"
    truth.write_text("1,1,0,0,9,9,1,1,1\n")
    assert main(["score", str(tracks), "--truth", str(truth)]) == 2
    assert f"{tracks} cannot be read (No such file or directory)" in capsys.readouterr().err
    assert main(["score", str(tracks), "--truth", str(truth), "--classes", "car,,van"]) == 2
    assert "--classes 'car,,van' has an empty name" in capsys.readouterr().err
