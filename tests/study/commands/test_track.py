"""``hvt-study track`` and the MOTChallenge files it reads and writes."""

import json

import numpy as np
import pytest

from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.values import Detections
from hvt_study.cli import main
from hvt_study.commands.track import read_detections, tracked

LINE = "{frame},-1,{x},20,40,60,{score},-1,-1,-1\n"


def write(path, lines):
    path.write_text("".join(lines))
    return path


def moving(frames, *, score=0.9):
    """Lines of one object at 2 px a frame."""
    return [LINE.format(frame=k, x=100 + 2 * k, score=score) for k in frames]


def sentence(capsys, *arguments):
    """The one line on stderr of a call that must end with exit code 2."""
    assert main([str(each) for each in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("hvt-study: ")
    return lines[0]


@pytest.mark.realdata
def test_upstream_is_reproduced_from_file_to_file(data, tmp_path, capsys):
    """Whoever checks the tracker against the authors' program would find another result."""
    results = json.loads((data / "tracking/palace/detections.json").read_text())["results"]
    sides = ("x", "y", "width", "height", "prob")
    lines = [f"{int(r['frame_id']) + 1},-1,{','.join(str(r[side]) for side in sides)}\n" for r in results]
    source, out = write(tmp_path / "det.txt", lines), tmp_path / "tracks.txt"
    options = "--fps=30 --track-thresh=0.5 --track-buffer=30 --match-thresh=0.8 --min-box-area=10"
    assert main(["track", str(source), "--out", str(out), *options.split()]) == 0
    assert capsys.readouterr().out == f"{out}: 314 frames, 45 tracks, 5961 boxes\n"
    files = (out, data / "tracking/palace/bytetrack_tracks.txt")
    ours, theirs = (np.loadtxt(path, delimiter=",") for path in files)
    theirs[:, 0] += 1
    theirs = theirs[np.lexsort((theirs[:, 1], theirs[:, 0]))]
    np.testing.assert_array_equal(ours[:, [0, 1, 7, 8, 9]], theirs[:, [0, 1, 7, 8, 9]])
    np.testing.assert_allclose(ours[:, 2:7], theirs[:, 2:7], atol=1e-3)


@pytest.mark.parametrize(
    ("boxes", "corners"),
    [
        (((10, 300, 20, 30), (200, 15, 20, 30)), False),
        (((10, 300, 30, 330), (200, 15, 220, 45)), True),
        (((100, 60, 300, 240),), False),
        (((100, 60, 300, 240), (90, 70, 305, 238)), False),
    ],
)
def test_corners_in_place_of_sizes_are_told_of(tmp_path, caplog, boxes, corners):
    """Boxes that reach over the whole picture were tracked without a word; one close object is none of these."""
    lines = [f"{frame},-1,{','.join(map(str, box))},0.9\n" for frame in range(1, 11) for box in boxes]
    read_detections(write(tmp_path / "det.txt", lines))
    assert ("are they corners, x1,y1,x2,y2? Accepted is frame,id,x,y,w,h,score" in caplog.text) == corners


def test_frames_without_detections_are_stepped(tmp_path):
    """A track hidden for longer than the buffer would come back with its old id, or a short gap would end it."""
    out = tmp_path / "out.txt"
    for gap, ids in ((20, [1]), (60, [1, 2])):
        source = write(tmp_path / f"{gap}.txt", moving([*range(1, 10), *range(10 + gap, 20 + gap)]))
        assert main(["track", str(source), "--out", str(out)]) == 0
        rows = read_detections(out)
        assert sorted(set(rows["id"].tolist())) == ids
        assert rows["frame"].max() == 19 + gap


@pytest.mark.parametrize("fps", [1, 30, 240])
def test_frames_in_which_nothing_is_tracked_are_stepped_over(tmp_path, fps):
    """Two lines of a file, ten million frames apart, took 23 minutes, though nothing else could come of them."""
    chance = np.random.default_rng(5)
    starts = np.cumsum(chance.integers(1, 400, 40))
    frames = sorted({int(start + step) for start in starts for step in range(chance.integers(1, 6))})
    rows = read_detections(write(tmp_path / "det.txt", moving([*frames, 10_000_000])))

    class Counted(ByteTracker):
        updates = 0

        def update(self, *words, **more):
            self.updates += 1
            return super().update(*words, **more)

    settings = TrackerSettings(track_buffer=30)
    counted, each = Counted(settings, fps=fps), ByteTracker(settings, fps=fps)
    found = [one for one in tracked(counted, rows) if len(one)]
    boxes = dict(zip(rows["frame"].tolist(), rows.boxes(), strict=True))
    wanted = []
    for frame in range(1, frames[-1] + 1):
        box = boxes.get(frame, np.empty(0, np.float32)).reshape(-1, 4)
        seen = Detections(box, np.full(len(box), 0.9, np.float32), np.zeros(len(box), np.int32))
        wanted += [one] if len(one := each.update(seen, frame_index=frame)) else []
    assert [one.frame_index for one in found] == [one.frame_index for one in wanted]
    for one, other in zip(found, wanted, strict=True):
        assert one.ids.tolist() == other.ids.tolist()
        np.testing.assert_array_equal(one.boxes_xyxy_px, other.boxes_xyxy_px)
    assert counted.updates < frames[-1] + 3 * 245


def test_options_reach_the_tracker(tmp_path):
    """Comparisons with other parameters would compare nothing."""
    source = write(tmp_path / "det.txt", moving(list(range(1, 8)), score=0.45))
    out = tmp_path / "out.txt"

    def boxes(*options: str) -> int:
        assert main(["track", str(source), "--out", str(out), *options]) == 0
        return len(read_detections(out))

    assert boxes() == 0
    assert boxes("--track-thresh", "0.3") == 7
    assert boxes("--track-thresh", "0.3", "--new-thresh", "0.5") == 0
    assert boxes("--track-thresh", "0.3", "--min-box-area", "2400.5") == 0
    # IoU * 0.45 is never above 0.6; without the score the IoU alone is.
    assert boxes("--track-thresh", "0.3", "--match-thresh", "0.4") < 7
    assert boxes("--track-thresh", "0.3", "--match-thresh", "0.4", "--no-fuse-scores") == 7


def test_unordered_lines_blank_lines_and_further_columns_are_read(tmp_path):
    """Files of other detectors would be refused, or their frames mixed up."""
    path = tmp_path / "det.txt"
    path.write_bytes(
        b"\xef\xbb\xbf3,-1,1,2,10,20,0.5,-1,-1,-1\r\n\r\n1, -1, 5,6,7,8, 0.25\r\n3,-1,1,2,10,20,0.75,x\r\n"
    )
    seen = {}

    class Seeing(ByteTracker):
        def update(self, detections, *, frame_index, image=None):
            seen[frame_index] = detections
            return super().update(detections, frame_index=frame_index)

    list(tracked(Seeing(fps=30), read_detections(path)))
    assert sorted(seen) == [1, 2, 3]
    assert len(seen[2]) == 0
    np.testing.assert_allclose(seen[1].boxes_xyxy_px, [[5, 6, 12, 14]])
    assert seen[3].confidences.tolist() == [0.5, 0.75]


def test_an_empty_file_gives_an_empty_file(tmp_path, capsys):
    """A sequence without any object would stop a batch of experiments."""
    source, out = write(tmp_path / "det.txt", ["\n"]), tmp_path / "out.txt"
    assert main(["track", str(source), "--out", str(out)]) == 0
    assert out.read_text() == ""
    assert "0 frames, 0 tracks, 0 boxes" in capsys.readouterr().out


def test_detections_without_area_are_left_out_and_counted(tmp_path, capsys):
    """One box turned inside out would spoil all tracks, or vanish without a word."""
    lines = [*moving([1, 2, 3]), "2,-1,5,5,-4,9,0.9\n", "3,-1,5,5,0,9,0.9\n"]
    assert main(["track", str(write(tmp_path / "d.txt", lines)), "--out", str(tmp_path / "o.txt")]) == 0
    assert "3 frames, 1 tracks, 3 boxes; 2 detections without area left out" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "accepted"),
    [
        ("2,-1,1,2,3", ""),
        ("99999999999,-1,1,2,3,4,0.9", ""),
        ("frame,id,x,y,w,h,score", ""),
        ("2 -1 1 2 3 4 0.9", ""),
        # Scores of 0 to 100 would all be certain, and a file of tracks be tracked again.
        ("2,-1,10,10,20,20,87.5", "a score from 0 to 1 in column 7"),
        ("2,-1,10,10,20,20,-0.5", "a score from 0 to 1 in column 7"),
        ("2,7,10,10,20,20,0.5", "-1 in column 2"),
    ],
)
def test_a_wrong_line_is_named(tmp_path, capsys, line, accepted):
    """The user would search a file of a million lines for the bad one."""
    source = write(tmp_path / "det.txt", [*moving([1]), line + "\n"])
    said = sentence(capsys, "track", source, "--out", tmp_path / "out.txt")
    assert f"{source}, line 2 is {line!r}; accepted is {accepted}" in said
    assert not (tmp_path / "out.txt").exists()


def test_wrong_files_and_arguments_are_one_sentence(tmp_path, capsys):
    """The user would be shown a traceback in place of what to change."""
    source, out = write(tmp_path / "det.txt", moving([1, 2])), ("--out", tmp_path / "out.txt")
    shares = write(tmp_path / "shares.txt", ["1,-1,.1,.1,.2,.2,0.5\n"])
    binary = tmp_path / "model.onnx"
    binary.write_bytes(b"\x08\x07\xff\xfe\x80")
    for words, said in (
        (("track", tmp_path / "none.txt", *out), "none.txt cannot be read"),
        (("track", shares, *out), "shares.txt has boxes of 0 to 1, and boxes are in pixels there"),
        (("track", binary, *out), "not UTF-8 text"),
        (("track", tmp_path, *out), "cannot be read"),
        (("track", source, "--out", tmp_path / "no" / "out.txt"), "cannot be written"),
        (("track", source, "--out", source), f"--out {source} is {source} itself"),
        *(
            (("track", source, *out, f"--fps={fps}"), f"--fps: is {fps},")
            for fps in (0, -5, "nan", "inf", "fast")
        ),
        (("track", source, *out, "--track-thresh=2"), "--track-thresh: is 2,"),
        (("track", source, *out, "--low-thresh=0.9"), "--low-thresh is 0.9"),
        (("track", source, *out, "--track-buffer=-1"), "--track-buffer: is -1,"),
        *((("track", source), "--out"), (("fly",), "invalid choice: 'fly'"), ((), "COMMAND")),
    ):
        assert said in sentence(capsys, *words)
