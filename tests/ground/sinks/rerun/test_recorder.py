"""The recording: whole at every moment, small, and telling what was logged."""

import errno
import os
import subprocess
import threading
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from hvt_archive.viewer import viewer_program
from hvt_common.errors import UserError
from hvt_ground.events import Event, Notice, Overlay, Refinement, Traffic, VideoSample
from hvt_ground.sinks.palette import class_colour
from hvt_ground.sinks.rerun import recorder as recorder_module
from hvt_ground.sinks.rerun.overlays import CENTRE_STEP_PX, HALF_SIZE_STEP_PX, OverlayEncoder
from hvt_ground.sinks.rerun.recorder import Recorder
from hvt_ground.sinks.rerun.still_places import CANVAS, SLOTS, Gallery, frame_of, placed
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames, moving_boxes, session
from programs.rrd import Recording, killed, recorded, settings
from rigs import examples

SIZE = (320, 192)
FRAMES = 45
TRACKS = 12


@pytest.fixture(scope="module")
def units() -> list[tuple[bytes, bool]]:
    """Three seconds of real x265 access units, a keyframe every 20."""
    return coded(drawn_frames(FRAMES), kbps=300, keyint=20)


@pytest.fixture(scope="module")
def events(units: list[tuple[bytes, bool]]) -> list[Event]:
    return [event for event, _ in session(drawn_frames(FRAMES), units, tracks=TRACKS, total_kbps=500)]


def of(kind: type, events: list[Event]) -> list:
    return [event for event in events if isinstance(event, kind)]


@pytest.fixture(scope="module")
def recording(events: list[Event], tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Recording(recorded(tmp_path_factory.mktemp("rrd") / "flight.rrd", events))


def read_back(path: Path, events: Iterable[Event], **changes: Any) -> Recording:
    return Recording(recorded(path / "a.rrd", events, **changes))


def test_the_video_is_the_stream_as_received(recording: Recording, events: list[Event]) -> None:
    """A recording would not show what the link carried, or not at its time, or no player could decode it."""
    logged = [(s.frame_index, s.capture_ns, s.data) for s in of(VideoSample, events)]
    assert recording.video() == logged
    assert recording.rows("/base/video", "VideoStream:codec")[0][2] == [int.from_bytes(b"hev1")]
    decoder = av.CodecContext.create("hevc", "r")
    decoder.thread_type = "SLICE"
    pictures = [p for _, _, data in recording.video() for p in decoder.decode(av.Packet(data))]
    assert [(one.width, one.height) for one in pictures] == [SIZE] * FRAMES


def test_it_opens_as_a_screen(recording: Recording) -> None:
    """It would open as a heap of entities; a third timeline offer a time that means nothing, in every row."""
    assert (recording.blueprints, recording.timelines) == (1, {"frame", "capture_time"})
    text = recording.rows("/session", "TextDocument:text")[0][2][0]
    assert all(one in text for one in ("uav-1", "method **M5**", "400"))


def test_every_frame_shows_the_boxes_that_were_logged(recording: Recording, events: list[Event]) -> None:
    """Boxes that lag or drift would put a class on the wrong car."""
    limit = CENTRE_STEP_PX + HALF_SIZE_STEP_PX + 0.01
    for overlay in of(Overlay, events):
        boxes = recording.boxes(overlay.frame_index)
        assert sorted(boxes) == overlay.track_ids.tolist()
        for i, track in enumerate(overlay.track_ids.tolist()):
            read = boxes[track]
            assert np.abs(np.array(read.box_px) - overlay.boxes_base_px[i]).max() <= limit
            assert (read.class_before, read.class_after) == (overlay.base_classes[i], overlay.classes[i])
            assert abs(read.confidence_pct / 100 - overlay.confidences[i]) < 0.055
            assert read.refined == overlay.refined[i]


def test_a_refined_track_says_so(recording: Recording, events: list[Event]) -> None:
    """The user must see in the picture which classes rest on a still, and what they were before."""
    last = of(Overlay, events)[-1]
    boxes = recording.boxes(last.frame_index)
    labels = {track: boxes[track].label for track in last.track_ids[last.refined].tolist()}
    assert len(labels) >= 3
    changed = {track for track in labels if boxes[track].class_before != boxes[track].class_after}
    assert changed
    assert {label for track, label in labels.items() if track not in changed} == {""}
    spoken = {track for track in changed if labels[track]}
    assert spoken
    assert all(labels[track] == f"{track} {boxes[track].class_after}" for track in spoken)


def test_every_still_is_there_beside_its_base_crop(recording: Recording, events: list[Event]) -> None:
    """The gallery is how a user judges what the stills are worth."""
    refinements = of(Refinement, events)
    assert len(refinements) > SLOTS
    stills = recording.stills()
    assert sorted(stills) == sorted((r.frame_index, r.still) for r in refinements)
    crops = recording.base_crops()
    assert len(crops) >= SLOTS
    by_frame = {r.frame_index: r for r in refinements}
    for frame, data in crops:
        crop = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        candidates = [r.base_crop_bgr for r in refinements if r.frame_index == frame]
        assert any(crop.shape == c.shape and np.abs(crop.astype(int) - c).mean() < 12 for c in candidates)
        assert frame in by_frame


def test_a_finer_still_is_shown_beside_an_enlarged_crop(events: list[Event], tmp_path: Path) -> None:
    """Side by side at different sizes the eye compares size, not detail."""
    refinement = of(Refinement, events)[0]
    large = cv2.resize(refinement.base_crop_bgr, None, fx=3, fy=3)
    still = cv2.imencode(".png", large)[1].tobytes()
    first = replace(refinement, still=still, media_type="image/png")
    read = read_back(tmp_path, [first, replace(first, still_sequence=1, base_crop_bgr=None)])
    shapes = [cv2.imdecode(np.frombuffer(data, np.uint8), 1).shape for _, data in read.base_crops()]
    assert large.shape in shapes
    assert (3, 4, 3) in shapes  # a frame that was gone is a blank, not the crop of the still before
    assert all(data[:2] == b"\xff\xd8" for _, data in read.stills())  # the viewer knows them for JPEG


def test_traffic_and_tracks_are_plotted(recording: Recording, events: list[Event]) -> None:
    """The user checks the budget on this plot."""
    traffic = of(Traffic, events)
    rates = [[one / 1e3 for one in (t.total_bps, t.base_bps, t.roi_bps, t.budget_bps)] for t in traffic]
    assert recording.lines("/link/bitrate") == [
        (t.frame_index, rate) for t, rate in zip(traffic, rates, strict=True)
    ]
    latencies = recording.lines("/link/latency")
    assert [values[0] for _, values in latencies] == [40.0] * len(traffic)
    assert all(np.isnan(values[1]) for _, values in latencies)
    assert recording.lines("/link/tracks")[-1][1] == [TRACKS, traffic[-1].tracks_refined]


def test_events_name_the_still_that_caused_a_refinement(recording: Recording, events: list[Event]) -> None:
    """Whoever doubts a class must find the still behind it."""
    logged = recording.events()
    first = of(Refinement, events)[0]
    texts = [text for frame, _, text in logged if frame == first.frame_index]
    wanted = f"still #0 → track {first.track_id}: {first.class_before} → {first.class_after} .90"
    assert any(text.startswith(wanted) and "small" in text for text in texts)
    assert (FRAMES - 1, "WARN", "edge gone") in logged
    assert len(logged) == len(of(Refinement, events)) + 1


def test_nothing_undecodable_is_logged(units: list[tuple[bytes, bool]], tmp_path: Path) -> None:
    """Rerun shows garbage for what no decoder can start with, and restarts when time runs backwards."""
    without_parameters = VideoSample(1, START_NS, units[1][0], keyframe=True)
    order = (3, 4, 20, 21, 21, 20, 22)
    samples = [VideoSample(index, START_NS + index * STEP_NS, *units[index]) for index in order]
    empty = VideoSample(23, START_NS + 23 * STEP_NS, b"", keyframe=False)
    read = read_back(tmp_path, [without_parameters, *samples, empty])
    assert [frame for frame, _, _ in read.video()] == [20, 21, 22]


def test_folding_changes_nothing_but_the_size(events: list[Event], tmp_path: Path) -> None:
    """The append log is rewritten while recording; a row lost or doubled there would be lost for good."""
    plain, compacted = tmp_path / "plain.rrd", tmp_path / "folded.rrd"
    sizes: list[int] = []
    for path, limit in ((plain, 1 << 40), (compacted, 20_000)):
        with Recorder(settings(path, compact_bytes=limit)) as recorder:
            for event in events:
                recorder.log(event)
            assert recorder.size_bytes == path.stat().st_size
            sizes.append(recorder.size_bytes)
    one, other = Recording(plain), Recording(compacted)
    for read in (Recording.video, Recording.events, Recording.stills, lambda one: one.boxes(FRAMES - 1)):
        assert read(one) == read(other)
    assert sizes[1] < 0.8 * sizes[0]


def test_two_recorders_do_not_mix(events: list[Event], tmp_path: Path) -> None:
    """One ground serves several edges at once, one recording each."""
    a = Recorder(settings(tmp_path / "a.rrd", edge_id="a"))
    b = Recorder(settings(tmp_path / "b.rrd", edge_id="b"))
    for event in of(VideoSample, events)[:30]:
        a.log(event)
        if event.frame_index < 10:
            b.log(event)
        b.log(Notice(event.frame_index, event.capture_ns, "info", "only b"))
    a.close()
    b.close()
    one, other = Recording(tmp_path / "a.rrd"), Recording(tmp_path / "b.rrd")
    assert (len(one.video()), len(one.events())) == (30, 0)
    assert (len(other.video()), len(other.events())) == (10, 30)


def test_closing_twice_is_fine_and_nothing_is_written_after(events: list[Event], tmp_path: Path) -> None:
    """Ctrl-C during the end closes twice, and a late thread may still log."""
    path = tmp_path / "a.rrd"
    recorder = Recorder(settings(path))
    recorder.log(events[0])
    recorder.close()
    size = path.stat().st_size
    recorder.close()
    recorder.log(events[1])
    assert path.stat().st_size == size


@pytest.mark.parametrize(
    ("name", "said"),
    [("no/such/f.rrd", "does not exist"), ("", "is a folder"), ("/dev/full", "No space left")],
)
def test_a_path_that_cannot_be_written_is_one_sentence(tmp_path: Path, name: str, said: str) -> None:
    """The user mistyped --record and should read what to mend; or it silently stops, found out when it is needed."""
    with pytest.raises(UserError, match=said):
        Recorder(settings(tmp_path / name))
    assert Path("/dev/full").is_char_device(), "what was there before is not removed"


@pytest.mark.parametrize("writes", ["nothing", "half"])
def test_a_disk_that_fails_for_a_moment_harms_nothing(
    events: list[Event], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: str
) -> None:
    """Half a minute that the file had was written over at its end; or half a message stayed in the middle."""
    path = tmp_path / "a.rrd"
    recorder, write = Recorder(settings(path)), os.pwrite
    for event in events:
        recorder.log(event)

    def fail(file: int, data: bytes, at: int) -> int:
        if writes == "half" and len(data) > 1000:
            return write(file, data[:1000], at)
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", fail)
        patch.setattr(os, "ftruncate", lambda *_: fail(0, b"", 0))
        with pytest.raises(UserError, match="Input/output error"):
            recorder.log(Notice(FRAMES, START_NS + FRAMES * STEP_NS, "info", "of the moment"))
    recorder.close()
    subprocess.run([viewer_program(), "rrd", "verify", path], check=True, capture_output=True)
    assert writes == "half" or len(Recording(path).video()) == FRAMES


def test_a_killed_process_leaves_all_that_was_logged(events: list[Event], tmp_path: Path) -> None:
    """A ground station's power goes when it likes."""
    out = tmp_path / "killed.rrd"
    opens = "from hvt_ground.sinks.rerun.recorder import Recorder; sink = Recorder(settings)"
    last = killed(opens, settings(out), events, feed=tmp_path / "feed", at=30)
    read = Recording(out)
    frames = [frame for frame, _, _ in read.video()]
    assert frames[: last + 1] == list(range(last + 1))
    assert len(read.boxes(last)) == TRACKS


@pytest.mark.parametrize("frames", [1, 30, 45])
def test_a_recording_that_ended_verifies(events: list[Event], tmp_path: Path, frames: int) -> None:
    """Tools that index recordings refuse a file without a footer, and the shortest flights have none."""
    path = tmp_path / "a.rrd"
    with Recorder(settings(path, compact_bytes=20_000)) as recorder:
        for event in events:
            if event.frame_index < frames:
                recorder.log(event)
    assert recorder.size_bytes == path.stat().st_size
    subprocess.run([viewer_program(), "rrd", "verify", path], check=True, capture_output=True)
    recording = Recording(path)
    assert len(recording.video()) == frames
    assert recording.blueprints == 1
    assert list(tmp_path.iterdir()) == [path]


def test_in_a_hurry_the_footer_is_left_out(events: list[Event], tmp_path: Path) -> None:
    """Ctrl-C would wait for an hour's recording to be written once more."""
    path, hurry = tmp_path / "a.rrd", threading.Event()
    hurry.set()
    recorder = Recorder(settings(path))
    for event in events:
        recorder.log(event)
    recorder.close(hurry)
    assert len(Recording(path).video()) == FRAMES
    assert list(tmp_path.iterdir()) == [path]


def test_a_recording_that_was_removed_is_noticed(events: list[Event], tmp_path: Path) -> None:
    """A flight would be written for hours into a file that nobody will find."""
    path = tmp_path / "a.rrd"
    recorder = Recorder(settings(path))
    recorder.log(events[0])
    path.unlink()
    for writes in (lambda: recorder.log(events[1]), recorder.close):
        with pytest.raises(UserError, match="it was removed"):
            writes()
    assert list(tmp_path.iterdir()) == []


def test_each_edge_has_a_screen_of_its_own(tmp_path: Path) -> None:
    """A viewer that shows two edges would show both with the size, budget and plots of the one that came last."""
    stores = set()
    for edge in ("uav-1", "uav-2"):
        reader = Recording(recorded(tmp_path / f"{edge}.rrd", (), edge_id=edge)).reader
        (recording,), (blueprint,) = reader.recordings(), reader.blueprints()
        assert recording.application_id == blueprint.application_id
        assert recording.recording_id == f"{edge}-00ff", "a backlog of the session is shown with it"
        stores.add(recording.application_id)
    assert len(stores) == 2


def test_plots_have_a_hole_where_nothing_came(tmp_path: Path) -> None:
    """A line through an outage says that the link carried something."""
    times = [(15 * second, START_NS + second * 1_000_000_000) for second in (0, 1, 2, 9, 10)]
    recording = read_back(tmp_path, [Traffic(*at, 3e5, 1e5, 4e5, 4e5, 20.0, 40.0, 7, 2) for at in times])
    for entity in ("/link/bitrate", "/link/latency", "/link/tracks"):
        rows = recording.lines(entity)
        assert [frame for frame, _ in rows] == [0, 15, 30, 31, 135, 150]
        assert [bool(np.isnan(values).all()) for _, values in rows] == [False] * 3 + [True] + [False] * 2


def test_the_session_panel_says_what_came(units: list[tuple[bytes, bool]], tmp_path: Path) -> None:
    """It said "at 15 fps" of a flight of which 3 came."""
    path = tmp_path / "a.rrd"
    recorder = Recorder(settings(path))
    assert "up to 15 fps" in Recording(path).rows("/session", "TextDocument:text")[-1][2][0]
    for index in range(5):  # every fifth frame; each is a keyframe to the decoder
        recorder.log(VideoSample(5 * index, START_NS + 5 * index * STEP_NS, *units[0]))
    recorder.close()
    assert "3.57 of 15 fps came" in Recording(path).rows("/session", "TextDocument:text")[-1][2][0]


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("base_kbps", "total_kbps"), [(240, 300), pytest.param(650, 800, marks=pytest.mark.nightly)]
)
def test_a_recording_is_at_most_half_as_large_again_as_what_was_received(
    data: Path, tmp_path: Path, base_kbps: int, total_kbps: int
) -> None:
    """A recording that outgrows its link cannot be kept, sent or archived."""
    frames = _carpark(data, 75)
    units = coded(frames, kbps=base_kbps)
    frames, units = frames * 4, units * 4  # 20 s; each quarter begins at a keyframe as the first
    timed = list(session(frames, units, tracks=58, total_kbps=total_kbps))
    path = tmp_path / "a.rrd"
    sent = [event for event, _ in timed]
    assert len(read_back(tmp_path, sent, base_size=(1280, 720), budget_bps=total_kbps * 1000).video()) == 300
    assert path.stat().st_size <= 1.5 * sum(size_bytes for _, size_bytes in timed)


def _carpark(data: Path, count: int) -> list[np.ndarray]:
    frames = []
    with av.open(str(data / "clips" / "drone_carpark.mp4")) as container:
        for frame in container.decode(video=0):
            picture = np.zeros((720, 1280, 3), np.uint8)
            picture[:, 90:1190] = frame.to_ndarray(format="bgr24")
            frames.append(picture)
            if len(frames) == count:
                break
    return frames


def overlay(frame: int, boxes: np.ndarray, *, refined: bool = False, confidence: float = 0.8) -> Overlay:
    values = {"refined": np.full(len(boxes), refined), "confidences": np.float32([confidence] * len(boxes))}
    return examples.overlay(frame, boxes, capture_ns=START_NS + frame * STEP_NS, **values)


def test_an_overlay_that_shows_the_same_writes_nothing() -> None:
    """Jitter below what one can see would be most of the recording."""
    encoder = OverlayEncoder((1280, 720))
    boxes = moving_boxes(0, 5, (640, 360))
    assert encoder.encode(overlay(0, boxes))
    assert encoder.encode(overlay(1, boxes + 0.3, confidence=0.82)) == []
    moved = encoder.encode(overlay(2, boxes + 2.0))
    assert [u.layer for u in moved] == ["tracks"]
    assert moved[0].components.keys() == {"boxes"}


def test_slow_drift_is_followed() -> None:
    """Held against jitter must not mean left behind."""
    encoder = OverlayEncoder((1280, 720))
    boxes = moving_boxes(0, 5, (640, 360))
    centres = None
    for i in range(50):
        for update in encoder.encode(overlay(i, boxes + 0.1 * i)):
            centres = update.components["boxes"][:, :2]
        wanted = (boxes[:, :2] + boxes[:, 2:]) / 2 + 0.1 * i
        assert np.abs(centres - wanted).max() <= CENTRE_STEP_PX + 1e-3


def test_tracks_that_end_leave_the_screen() -> None:
    """A box that stays after its car has gone is a ghost."""
    encoder = OverlayEncoder((1280, 720))
    encoder.encode(overlay(0, moving_boxes(0, 5, (640, 360))))
    (update,) = encoder.encode(overlay(1, np.empty((0, 4))))
    assert len(update.components["boxes"]) == 0
    assert update.components["identity"].track_ids == ()


def test_movement_yields_to_the_allowance_but_news_does_not() -> None:
    """Fifty boxes in motion at a low rate would otherwise outweigh the video."""
    encoder = OverlayEncoder((1280, 720), share=0.1, credit_bytes=1000)
    boxes = moving_boxes(0, 50, (1280, 720))
    written = sum(bool(encoder.encode(overlay(i, boxes + 3.0 * i))) for i in range(30))
    assert 1 <= written < 10
    assert encoder.encode(overlay(31, boxes, refined=True))
    encoder.earn(20_000)
    assert encoder.encode(overlay(32, boxes + 50, refined=True))


def test_a_hundred_boxes_follow_a_camera_that_pans() -> None:
    """At 800 kbps the boxes of a recording stood on the ground beside their cars for three frames of four."""
    encoder = OverlayEncoder((1280, 720))
    boxes = moving_boxes(0, 120, (1280, 720))
    for frame in range(150):
        encoder.earn(700_000 // 8 // 15)
        assert encoder.encode(overlay(frame, boxes + 5.0 * frame)), frame


def test_the_gallery_holds_what_one_is_looking_at() -> None:
    """Pairs that flicker by cannot be compared; a changed class is worth the place of one that was confirmed."""
    gallery = Gallery(hold_ns=1_000_000_000)
    slots = [gallery.put(i, i, changed=i == 0) for i in range(SLOTS)]
    assert sorted(slots) == list(range(SLOTS))
    assert gallery.put(20, 500_000_000, changed=False) is None
    assert gallery.put(20, 500_000_000, changed=True) == slots[1]  # the oldest that only confirmed
    assert gallery.put(30, 1_200_000_000, changed=False) == slots[0]


def test_a_picture_fits_its_half_of_the_slot() -> None:
    """Pictures that overlap or leave the canvas cannot be compared."""
    for slot in range(SLOTS):
        x1, y1, x2, y2 = frame_of(slot)
        assert 0 <= x1 < x2 <= CANVAS[0]
        assert 0 <= y1 < y2 <= CANVAS[1]
        for size in ((20, 200), (400, 30), (90, 60)):
            left, right = (placed(slot, size, right=side) for side in (False, True))
            assert left.x >= x1 - 0.01
            assert left.x + size[0] * left.scale <= right.x + 0.01
            assert right.x + size[0] * right.scale <= x2 + 0.01
            assert right.y >= y1 - 0.01
            assert right.y + size[1] * right.scale <= y2 + 0.01


def test_colours_tell_kinds_apart() -> None:
    """A van of the detector and a minivan of the classifier are the same kind; a car and a truck are not."""
    assert class_colour("van") == class_colour("minivan")
    assert class_colour("sports car, sport car") == class_colour("car")
    kinds = ("car", "van", "truck", "bus", "pedestrian", "bicycle", "motor", "tricycle")
    assert len(set(map(class_colour, kinds))) == 8
    assert class_colour("dragonfly") == class_colour("dragonfly")


def test_a_new_class_a_frame_fills_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each new name is written with all before it: an edge that names 2048 would write gigabytes."""
    monkeypatch.setattr(recorder_module, "MOST_CLASSES", 60)
    path, largest = tmp_path / "flight.rrd", 0
    with Recorder(settings(path, compact_bytes=20_000)) as written:
        box = moving_boxes(0, 1, SIZE)
        for number in range(120):
            name = (f"class {number} of a hostile edge",)
            shown = replace(overlay(number, box), track_ids=np.array([number]))
            written.log(replace(shown, classes=name, base_classes=name))
            largest = max(largest, path.stat().st_size)
    legend = Recording(path).rows("/base/legend", "Points2D:labels")[-1][2]
    assert (len(legend), "other" in legend) == (60, True)
    assert largest < 270_000
