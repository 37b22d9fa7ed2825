"""``hvt-ground export``: each kind opens in the program that it is for, and says what the ground knew."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import rerun as rr
from faster_coco_eval import COCO
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from mcap.reader import make_reader
from motmetrics.io import loadtxt

import hvt_ground.cli
from hvt_archive.exports.command import whole_file
from hvt_archive.joined import join_recordings
from hvt_archive.reading import readable
from hvt_common.errors import UserError
from hvt_common.units import Limit, utc_text
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.events import Event, Overlay, Refinement, VideoSample
from hvt_ground.recordings.session_files import SessionFiles
from hvt_ground.sinks.palette import GREY, SKY
from hvt_ground.sinks.rerun.recorder import Recorder
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames, session
from programs.rrd import Recording, damaged, ends_its_reader, recorded, settings
from programs.small_disk import small_disk
from rigs import examples
from rigs.messages import PLAIN

FRAMES, SIZE, TRACKS = 60, (320, 192), 6


@pytest.fixture(scope="module")
def events() -> list[Event]:
    """Four seconds."""
    drawn = drawn_frames(FRAMES, SIZE)
    return [
        one for one, _ in session(drawn, coded(drawn, kbps=300, keyint=20), tracks=TRACKS, total_kbps=500)
    ]


@pytest.fixture(scope="module")
def recording(events: list[Event], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("flight") / "flight.rrd", events)


def export(recording: Path, out: Path, *words: str) -> Path:
    assert hvt_ground.cli.main(["export", str(recording), *words, "--out", str(out)]) == 0
    assert [one.name for one in out.parent.iterdir() if one.name.endswith(".part")] == []
    return out


def lines(table: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    assert hvt_ground.cli.main(["export", *map(str, words)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("hvt-ground: "), said
    assert len(said.splitlines()) == 1
    return said


def pictures(events: list[Event]) -> list[np.ndarray]:
    decoder = BaseDecoder()
    return [decoder.decode(one.data) for one in events if isinstance(one, VideoSample)]


def shown(video: Path) -> list[float]:
    """When it shows each picture, seconds."""
    with av.open(str(video)) as opened:
        return [one.time for one in opened.decode(video=0)]


def messages(mcap: Path, topic: str, kind: Any = None) -> list:
    """Of a topic, or what they hold."""
    with mcap.open("rb") as file:
        found = [one for _, _, one in make_reader(file).iter_messages(topics=[f"/uav-1/{topic}"])]
    return found if kind is None else [kind.FromString(one.data) for one in found]


@pytest.mark.parametrize("kind", ["mp4", "mkv", "ts"])
def test_video_is_copied_with_its_capture_times(recording, events, tmp_path, kind):
    """A player would show other pictures, or at other times, than the camera took."""
    with av.open(str(export(recording, tmp_path / f"flight.{kind}"))) as video:
        assert video.streams.video[0].codec_context.name == "hevc"
        if kind == "mp4":  # else nobody could lay it beside another camera's
            assert video.metadata["creation_time"].startswith("2026-09-21T14:13:20")
        frames = [(one.time, one.to_ndarray(format="gray")) for one in video.decode(video=0)]
    times = np.array([time for time, _ in frames])
    assert np.allclose(times - times[0], np.arange(FRAMES) * STEP_NS / 1e9, atol=0.002)
    sent = [cv2.cvtColor(one, cv2.COLOR_BGR2GRAY).astype(float) for one in pictures(events)]
    apart = [np.abs(one.astype(float) - other).mean() for (_, one), other in zip(frames, sent, strict=True)]
    assert max(apart) < 20, "it shows something else"  # full and limited range
    assert np.corrcoef(frames[7][1].ravel(), sent[7].ravel())[0, 1] > 0.99


@pytest.mark.parametrize(("sizes", "tag"), [((SIZE,), "hvc1"), ((SIZE, (640, 384)), "hev1")])
def test_an_mp4_is_what_apple_plays_where_that_can_be(tmp_path, sizes, tag):
    """It would not open; or, with parameter sets that changed on the way, break off there."""
    units = [unit for size in sizes for unit, _ in coded(drawn_frames(20, size), kbps=300, keyint=20)]
    path = tmp_path / "flight.rrd"
    with Recorder(settings(path)) as recorder:
        for index, unit in enumerate(units):
            recorder.log(VideoSample(index, START_NS + index * STEP_NS, unit, keyframe=index % 20 == 0))
    with av.open(str(export(path, tmp_path / "flight.mp4"))) as video:
        assert video.streams.video[0].codec_context.codec_tag == tag
        assert sum(1 for _ in video.decode(video=0)) == len(units)


@pytest.mark.parametrize("options", [(), ("--burn-in",)])
def test_a_clock_that_was_set_leaves_a_video_its_pace(tmp_path, options):
    """Set back by an hour, an hour's pictures passed in seconds; set on by a year, it was no MP4."""
    path = tmp_path / "flight.rrd"
    with Recorder(settings(path)) as recorder:
        for index, (unit, _) in enumerate(coded(drawn_frames(21, SIZE), kbps=300, keyint=21)):
            moved_ns = (0, -3_600 * 10**9, 400 * 86_400 * 10**9)[index // 7]
            recorder.log(VideoSample(index, START_NS + index * STEP_NS + moved_ns, unit, keyframe=index == 0))
    times = shown(export(path, tmp_path / "flight.mp4", *options))
    assert np.allclose(np.diff(times), STEP_NS / 1e9, atol=0.002)


def test_boxes_are_drawn_in_on_request(recording, events, tmp_path):
    """Whoever gets the file has no viewer that lays boxes over it."""
    out = export(recording, tmp_path / "flight.mp4", "--burn-in")
    with av.open(str(out)) as video:
        assert video.streams.video[0].codec_context.name == "h264"
        drawn = [one.to_ndarray(format="bgr24") for one in video.decode(video=0)]
    plain = pictures(events)[30].astype(float)
    changed = np.abs(drawn[30].astype(float) - plain).max(axis=2) > 60
    (overlay,) = [one for one in events if isinstance(one, Overlay) and one.frame_index == 30]
    x1, y1, x2, _ = overlay.boxes_base_px[0].round().astype(int)
    assert changed[max(0, y1 - 2) : y1 + 3, x1:x2].any(), "no edge above the first object"
    assert changed.mean() < 0.25


def test_a_track_that_stills_doubt_stays_refined(events, tmp_path):
    """The recording has no layer for it: of a still's second object, and without its picture, that was lost."""
    still = replace(next(one for one in events if isinstance(one, Refinement)), frame_index=0)
    stills = [
        replace(still, still_sequence=1, track_id=1),
        replace(still, still_sequence=1, track_id=2, doubted=True, class_after="other"),
        replace(still, still_sequence=2, track_id=3, still=b"", still_bgr=None),
        replace(still, still_sequence=3, track_id=4, unread=True),
        replace(still, still_sequence=4, track_id=None),
    ]
    boxes = np.tile(np.array((9, 9, 40, 40), np.float32), (5, 1))
    doubted = examples.overlay(1, boxes, capture_ns=START_NS + STEP_NS, doubted=np.ones(5, np.bool_))
    out = export(recorded(tmp_path / "doubted.rrd", [events[0], *stills, doubted]), tmp_path / "t.csv")
    assert [row["refined"] for row in lines(out)] == ["1", "1", "1", "0", "0"]


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")  # of what motmetrics uses
def test_the_tracks_are_those_that_the_ground_had(recording, events, tmp_path):
    """A table that another program reads would be wrong, by more than the recording is coarse."""
    rows = lines(export(recording, tmp_path / "t.csv"))
    table = pq.read_table(export(recording, tmp_path / "t.parquet")).to_pylist()
    mot = loadtxt(export(recording, tmp_path / "t.txt", "--to", "mot"))
    overlays = {one.frame_index: one for one in events if isinstance(one, Overlay)}
    assert len(rows) == len(table) == len(mot) == FRAMES * TRACKS
    off = []
    for row, typed in zip(rows, table, strict=True):
        frame, track = int(row["frame_index"]), int(row["id"])
        overlay = overlays[frame]
        at = int(np.flatnonzero(overlay.track_ids == track)[0])
        assert (row["class"], row["base_class"]) == (overlay.classes[at], overlay.base_classes[at])
        assert row["refined"] == str(int(overlay.refined[at]))
        assert (typed["frame_index"], typed["id"], typed["class"]) == (frame, track, row["class"])
        x1, y1, x2, y2 = overlay.boxes_base_px[at].tolist()
        off.append(np.subtract([float(row[one]) for one in "xywh"], [x1, y1, x2 - x1, y2 - y1]))
        of_mot = mot.loc[(frame + 1, track), ["X", "Y", "Width", "Height"]].tolist()
        assert of_mot == pytest.approx([float(row[one]) for one in "xywh"], abs=0.06), "and its pixels from 1"
    # Boxes are held while they move by less than a pixel, and written less often where bytes are scarce.
    assert np.percentile(np.abs(off), 90) < 3
    assert rows[0]["capture_utc"] == "2026-09-21T14:13:20.000Z"


def test_the_data_set_opens_in_coco_tools(recording, events, tmp_path):
    """One would have to write the labels again to train on what was flown."""
    out = export(recording, tmp_path / "set", "--to", "coco")
    coco = COCO(str(out / "annotations.json"))
    assert len(coco.getImgIds()) == FRAMES
    names = {one["name"] for one in coco.loadCats(coco.getCatIds())}
    assert {"car", "van", "truck"} <= names
    image = coco.loadImgs([30])[0]
    picture = cv2.imread(str(out / image["file_name"]))
    assert (picture.shape[1], picture.shape[0]) == (image["width"], image["height"]) == SIZE
    assert np.abs(picture.astype(float) - pictures(events)[30]).mean() < 4
    boxes = coco.loadAnns(coco.getAnnIds(imgIds=[30]))
    assert len(boxes) == TRACKS
    assert {"id", "image_id", "category_id", "bbox", "area", "iscrowd", "track_id", "score"} == set(boxes[0])


def test_boxes_of_a_data_set_lie_in_its_pictures(events, tmp_path):
    """Boxes are recorded to half a pixel: trainers take the label for damaged, and leave the whole picture out."""
    boxes = np.array(
        [(-4, -0.5, 40, 40), (300, 180, 321, 193), (321, 0, 330, 9), (-9, 50, 0, 60)], np.float32
    )
    flight = recorded(tmp_path / "flight.rrd", [events[0], examples.overlay(0, boxes, capture_ns=START_NS)])
    out = export(flight, tmp_path / "set", "--to", "coco")
    found = json.loads((out / "annotations.json").read_text())["annotations"]
    assert [(one["track_id"], one["bbox"]) for one in found] == [(1, [0, 0, 40, 40]), (2, [300, 180, 20, 12])]


def test_the_stills_come_with_what_the_base_showed(recording, events, tmp_path):
    """The pictures that one looks for would stay inside the recording."""
    sent = {one.still for one in events if isinstance(one, Refinement)}
    out = export(recording, tmp_path / "pairs", "--to", "stills")
    rows = lines(out / "stills.csv")
    assert {(out / row["file"]).read_bytes() for row in rows} <= sent
    assert len(rows) >= 0.9 * len(sent)
    assert sum(bool(row["base_file"]) for row in rows) >= 20
    assert all(cv2.imread(str(out / row["base_file"])) is not None for row in rows if row["base_file"])
    assert any("→" in row["caption"] for row in rows)


def test_a_still_has_the_time_of_what_it_shows(events, tmp_path):
    """It is read a second later: beside the video it would be of another moment."""
    still = next(one for one in events if isinstance(one, Refinement))
    header = replace(PLAIN, frame_index=7, capture_ns=START_NS + 7 * STEP_NS)
    late = replace(still, frame_index=30, capture_ns=START_NS + 30 * STEP_NS, header=header)
    flight = recorded(tmp_path / "flight.rrd", [*events[:1], late])
    (row,) = lines(export(flight, tmp_path / "stills", "--to", "stills") / "stills.csv")
    assert (row["frame_index"], row["capture_utc"]) == ("7", utc_text(header.capture_ns))
    (message,) = messages(export(flight, tmp_path / "flight.mcap"), "stills")
    assert message.log_time == header.capture_ns


def test_an_export_says_how_many_stills_came_beyond_those_it_has(recording, events, tmp_path, capsys):
    """Who counts its files would take the link or the method for worse than it was."""
    export(recording, tmp_path / "whole.csv")
    assert "does not hold" not in capsys.readouterr().out
    still = next(one for one in events if isinstance(one, Refinement))
    noise = np.random.default_rng(7).integers(0, 255, (400, 400, 3), np.uint8)  # as JPEG far more than came
    more = replace(still, still_sequence=9999, media_type="image/webp", still_bgr=noise)
    export(recorded(tmp_path / "short.rrd", [*events, more]), tmp_path / "short.csv")
    assert "stills; 1 more came whose pictures the recording does not hold" in capsys.readouterr().out


def test_mcap_has_video_boxes_stills_and_events(recording, events, tmp_path):
    """Foxglove would open an empty file, or show boxes of another moment."""
    out = export(recording, tmp_path / "flight.mcap")
    with out.open("rb") as file:
        kinds = {channel.topic: schema.name for schema, channel, _ in make_reader(file).iter_messages()}
    assert set(kinds) == {f"/uav-1/{one}" for one in ("video", "tracks", "stills", "events")}
    assert kinds["/uav-1/video"] == "foxglove.CompressedVideo"
    video = messages(out, "video", CompressedVideo)
    assert [one.data for one in video] == [one.data for one in events if isinstance(one, VideoSample)]
    assert {one.format for one in video} == {"h265"}
    assert messages(out, "video")[10].log_time == START_NS + 10 * STEP_NS
    boxes = messages(out, "tracks", ImageAnnotations)[30]
    facts = [{one.key: one.value for one in points.metadata} for points in boxes.points]
    assert sorted(int(one["id"]) for one in facts) == list(range(1, TRACKS + 1))
    assert all(text.text.split()[0] == one["id"] for text, one in zip(boxes.texts, facts, strict=True))
    stamps = {one.timestamp.ToNanoseconds() for one in (boxes, *boxes.points, *boxes.texts)}
    assert stamps == {messages(out, "tracks")[30].log_time}, "each is laid over the picture of its time"


@pytest.mark.parametrize(
    ("field", "word", "colour"), [("doubted", "something", GREY), ("vague", "vehicle", SKY)]
)
def test_what_is_a_guess_has_the_same_word_in_each_picture(field, word, colour, events, tmp_path):
    """A guess of an unknown view bore its class in Foxglove and in the video, and none on the page."""
    guess: dict[str, Any] = {field: np.ones(TRACKS, np.bool_)}
    guesses = [replace(one, **guess) for one in events if isinstance(one, Overlay)]
    video: list[Event] = [one for one in events[:8] if isinstance(one, VideoSample)]
    path = recorded(tmp_path / "unknown.rrd", (*video, *guesses[:8]))
    drawn = messages(export(path, tmp_path / "unknown.mcap"), "tracks", ImageAnnotations)
    words = {text.text.split()[1] for one in drawn for text in one.texts}
    assert words == {word} == {box.word for box in Recording(path).boxes(4).values()}
    boxes = [box for one in drawn for box in one.points]
    colours = {(box.outline_color.r, box.outline_color.g, box.outline_color.b) for box in boxes}
    assert colours == {tuple(part / 255 for part in colour)}, "nor the colour of a class"
    facts = [{fact.key: fact.value for fact in box.metadata} for box in boxes]
    assert {fact["doubted"] for fact in facts} == {str(int(field == "doubted"))}
    assert {fact["class"] for fact in facts} <= {"car", "van", "truck", "bus"}


def test_a_ground_that_was_started_again_leaves_no_ghosts(events, tmp_path):
    """Boxes of the first recording would stand in the second, beside their own, or bear the names of its classes."""
    boats = ("boat",) * TRACKS
    halves: list[list[Event]] = [[], []]
    for event in events:
        second = event.frame_index >= 30
        if second and isinstance(event, Overlay):
            event = replace(event, track_ids=event.track_ids + 50, base_classes=boats, classes=boats)  # noqa: PLW2901
        if not isinstance(event, Refinement):
            halves[second].append(event)
    first, later = (recorded(tmp_path / f"{number}.rrd", half) for number, half in enumerate(halves))
    by_frame: dict[int, list[int]] = {}
    for row in lines(export(later, tmp_path / "both.csv", str(first))):
        assert [row[name] == "boat" for name in ("base_class", "class")] == [int(row["id"]) > 50] * 2
        by_frame.setdefault(int(row["frame_index"]), []).append(int(row["id"]))
    assert {len(ids) for ids in by_frame.values()} == {TRACKS}
    # The second begins at its first keyframe.
    assert min(by_frame[59]) > 50 >= max(by_frame[29])


@pytest.mark.parametrize("lost", [50, 3000])
def test_a_recording_that_breaks_off_is_exported_so_far(recording, tmp_path, lost):
    """A power cut would take the whole flight."""
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(recording.read_bytes()[:-lost])
    assert len(shown(export(cut, tmp_path / "cut.mp4"))) > FRAMES / 2


def test_of_half_a_finished_recording_nearly_half_is_exported(tmp_path):
    """A copy that was broken off had no picture where a flight was short: its video was one chunk."""
    noise = np.random.default_rng(0).integers(0, 255, (FRAMES, SIZE[1], SIZE[0], 3), np.uint8)
    path, units = tmp_path / "flight.rrd", coded(list(noise), kbps=4000, keyint=20)
    with Recorder(settings(path)) as recorder:
        for frame, (unit, _) in enumerate(units):
            recorder.log(VideoSample(frame, START_NS + frame * STEP_NS, unit, keyframe=frame % 20 == 0))
    os.truncate(path, path.stat().st_size // 2)
    assert len(shown(export(path, tmp_path / "cut.mp4"))) > FRAMES / 5


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-3000] + bytes(3000), lambda data: damaged(data, b"Boxes2D:half_sizes")]
)
def test_of_a_damaged_recording_the_rest_is_exported(recording, tmp_path, caplog, damage):
    """After a power cut a file may end in zeros, and cards lose bits: the whole flight was called no recording."""
    broken = tmp_path / "broken.rrd"
    broken.write_bytes(damage(recording.read_bytes()))
    assert len(shown(export(broken, tmp_path / "broken.mp4"))) == FRAMES
    assert f"{broken} is damaged or breaks off: what can be read is exported" in caplog.text


def test_pictures_that_need_a_lost_one_are_not_exported(tmp_path, caplog):
    """They counted as exported, and players showed smears; where the edge left frames out, others went as well."""
    path, live = tmp_path / "flight.rrd", tmp_path / "live.rrd"
    drawn = drawn_frames(FRAMES, SIZE)
    with Recorder(settings(path)) as recorder:
        for frame, (unit, _) in enumerate(coded(drawn, kbps=200, keyint=20)):
            number = frame if frame < 10 else 2 * frame
            recorder.log(VideoSample(number, START_NS + frame * STEP_NS, unit, keyframe=frame % 20 == 0))
        shutil.copy(path, live)
    _, _, unit = Recording(live).video()[25]
    live.write_bytes(damaged(live.read_bytes(), unit[40:60]))
    at = [round(time * 15) for time in shown(export(live, tmp_path / "out.mp4"))]
    assert at == [*range(25), *range(40, FRAMES)]
    assert "14 pictures after a hole are left out" in caplog.text


def test_a_recording_that_ends_the_process_of_its_reader_is_exported(recording, tmp_path, capfd):
    """The export ended with a signal, and a panic of the SDK's on the terminal."""
    broken = tmp_path / "broken.rrd"
    broken.write_bytes(ends_its_reader(recording.read_bytes()))
    reads = f"from rerun.chunk import RrdReader; list(RrdReader({str(broken)!r}).stream())"
    read = subprocess.run([sys.executable, "-c", reads], check=False, capture_output=True)
    assert read.returncode == -signal.SIGABRT
    readable._tries.rest()  # noqa: SLF001 - one started before would write to where that test looked
    assert len(shown(export(broken, tmp_path / "broken.mp4"))) == FRAMES
    assert "panicked" not in capfd.readouterr().err


def test_a_split_session_is_exported_as_one(recording, events, tmp_path):
    """A video would end where a file did."""
    sink = SessionFiles(settings(tmp_path / "part.rrd"), split=Limit(seconds=1.2))
    for event in events:
        sink.log(event)
    sink.close()
    last, *parts = sorted(tmp_path.glob("*.rrd"), reverse=True)
    assert parts
    times = shown(export(last, tmp_path / "all.mp4", *map(str, parts)))
    assert (len(times), times[-1]) == (FRAMES, pytest.approx((FRAMES - 1) / 15, abs=0.1))
    whole = export(recording, tmp_path / "whole", "--to", "stills")
    # a file that is named twice is read once
    split = export(last, tmp_path / "parts", *map(str, [*parts, parts[0]]), "--to", "stills")
    one, several = (
        [
            (row["frame_index"], row["caption"], (folder / row["file"]).read_bytes())
            for row in lines(folder / "stills.csv")
        ]
        for folder in (whole, split)
    )
    assert [still for still in several if still not in one] == [], "of another file's end, at its beginning"
    assert len({data for _, _, data in several}) >= 0.9 * len(one)
    assert len(several) <= len(one)


def test_what_cannot_be_is_said_in_one_sentence(recording, tmp_path, capsys):
    """A traceback, or a file that is no export; root's ``--out /dev/null`` would take it from every program."""
    files = {name: tmp_path / f"{name}.rrd" for name in ("wrong", "foreign", "absent", "other", "joined")}
    files["wrong"].write_bytes(b"RRF2" + bytes(100))
    with rr.RecordingStream("another program") as stream:
        stream.save(files["foreign"])
        stream.set_time("frame", duration=1.5)
        stream.log("/video", rr.VideoStream(codec=rr.VideoCodec.H265, sample=bytes(9)))
    recorded(files["other"], [], edge_id="uav-2", session="0aaa")
    join_recordings([recording, files["other"]], files["joined"], base_size=SIZE, fps=15.0)
    mine = tmp_path / "mine.rrd"
    shutil.copy(recording, mine)
    (tmp_path / "mine.csv").write_text("edited since", encoding="utf-8")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine", encoding="utf-8")
    os.mkfifo(tmp_path / "pipe")
    for words, said in (
        ("{wrong} --to mp4", "wrong.rrd is no recording"),
        ("{foreign} --to mp4", "foreign.rrd is no recording"),
        ("{absent} --to mp4", "absent.rrd cannot be read (No such file or directory): give .rrd files"),
        ("{here}/pipe --to csv", "pipe cannot be read (a pipe or a device, and no file): give .rrd files"),
        ("{here} --to csv", f"{tmp_path} cannot be read (Is a directory): give .rrd files"),
        ("{good}", "--to is missing: give one of mp4, mkv, ts"),
        ("{good} --to avi", "'avi'"),
        ("{good} --to csv --burn-in", "--burn-in draws into video, and --to is csv"),
        ("{good} {other} --to mp4", "are of 2 sessions"),
        ("{other} --to mp4", "recording of uav-2 has no video"),
        ("{other} --to stills", "has no stills"),
        ("{joined} --to mp4", "no recording of one edge"),
        ("{good} --to mp4 --out /", "has no name"),
        ("{good} --to coco --out {here}/full", "is there and not an empty folder"),
        ("{mine} --to csv", "mine.csv is there already"),
        ("{good} --to csv --out {here}/pipe", f"{tmp_path}/pipe is there and no file"),
    ):
        given = words.format(good=recording, here=tmp_path, mine=mine, **files).split()
        assert said in refused(capsys, *given)
    assert not list(tmp_path.glob("*.mp4")), "half a file"
    assert (tmp_path / "mine.csv").read_text() == "edited since"
    assert (tmp_path / "full" / "mine.txt").exists()
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("kind", ["mp4", "csv", "coco", "mcap", "ts"])
def test_a_full_disk_leaves_no_half_file(recording, tmp_path, capsys, kind):
    """It would be taken for a whole one."""
    with small_disk(tmp_path / "small", size="8k") as disk:
        out = disk / "flight" if kind == "coco" else disk / f"flight.{kind}"
        said = refused(capsys, recording, "--to", kind, "--out", out)
        assert f"{out} cannot be " in said
        assert "No space left on device" in said
        assert list(disk.iterdir()) == []


@pytest.mark.parametrize("name", ["itself", "a symbolic link", "a hard link", "over a folder"])
@pytest.mark.parametrize("kind", ["csv", "mp4"])
def test_no_export_goes_over_the_recording_that_it_reads(recording, tmp_path, capsys, name, kind):
    """The only recording of the flight would be a table of it."""
    source = tmp_path / "flight.rrd"
    shutil.copyfile(recording, source)
    out = source if name == "itself" else tmp_path / f"out.{kind}"
    if name == "a symbolic link":
        out.symlink_to(source)
    elif name == "a hard link":
        out.hardlink_to(source)
    elif name == "over a folder":
        (tmp_path / "more").mkdir()
        out = tmp_path / "more" / ".." / "flight.rrd"
    said = refused(capsys, source, "--to", kind, "--out", out)
    assert f"--out {out} is {source} itself, which is read: name another file" in said
    with pytest.raises(UserError, match=f"--out {re.escape(str(out))} is {source} itself"):
        join_recordings([source], out, base_size=SIZE, fps=15)
    assert source.read_bytes() == recording.read_bytes()
    export(source, tmp_path / "new", "--to", kind)


def test_a_link_stays_one(tmp_path):
    """Who links the newest table to one place would read an old one for ever."""
    (tmp_path / "link").symlink_to(tmp_path / "table")
    with whole_file(tmp_path / "link") as part:
        part.write_text("new", encoding="utf-8")
    assert (tmp_path / "link").readlink() == tmp_path / "table"
    assert (tmp_path / "table").read_text(encoding="utf-8") == "new"


@pytest.mark.parametrize("kind", ["mp4", "csv", "parquet", "mcap", "mot"])
def test_a_name_that_is_no_text_is_a_name(recording, tmp_path, kind):
    """A file off another system ended the export with a traceback."""
    out = tmp_path / os.fsdecode(b"fl\xffight")
    assert export(recording, out, "--to", kind).stat().st_size > 0


def test_a_name_that_nobody_gave_is_never_taken_from_another_export(tmp_path):
    """Two exports of one recording at once: the table of the first would be gone."""
    out = tmp_path / "flight.csv"
    with pytest.raises(UserError, match="is there already"), whole_file(out, new=True) as part:  # noqa: PT012
        part.write_text("late")
        out.write_text("first")
    assert out.read_text() == "first"
    assert [one.name for one in tmp_path.iterdir()] == ["flight.csv"]
