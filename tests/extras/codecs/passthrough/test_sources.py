"""Sources whose frames come with the camera's own units: real files, and a real RTSP camera."""

import time
from functools import partial
from itertools import count, pairwise
from pathlib import Path

import numpy as np
import pytest

from hvt_codecs.passthrough import sources as coded_source
from hvt_codecs.passthrough.camera import Passthrough
from hvt_codecs.passthrough.sources import CameraPacket, CodedLiveSource, CodedStreamGrabber
from hvt_codecs.passthrough.stage import measure_camera
from hvt_codecs.passthrough.stream import CameraDecoder, CameraUnits, SeenUnit, rate_of, without_jumps
from hvt_common.errors import FlightError, UserError
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.video.hevc import BaseDecoder, nal_kind, nal_units, parameter_sets
from hvt_edge.source.contract import SourceSettings
from hvt_edge.source.live import Shot, SignalLost
from media.clips import hard_pictures, smooth_pictures
from media.hevc_camera import SIZE, packets_of, pictures_of, write_clip
from media.numbered import copied
from programs.processes import eventually
from programs.rtsp_camera import RtspCamera

SETTINGS = SourceSettings(size=lambda size: size, fps=15)


def coded(spec, *, size=None, **settings):
    return Passthrough.open_source(str(spec), size=size or SETTINGS.size, fps=15, **settings)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.hevc", "a.ts"])
def test_each_frame_of_a_clip_comes_with_its_unit(tmp_path, name):
    """The picture that the edge analyzes would be another than the ground shows under the same number."""
    clip = write_clip(tmp_path / name, fps=20)
    with coded(clip) as source:
        assert (source.fps, source.live, source.view.base_size) == (20, False, SIZE)
        frames = list(source.frames(start_ns=SECOND_NS))
        assert source.camera_stream.keyframe_s == pytest.approx(0.5, abs=0.01)
        sizes = [len(one.camera_unit.data) for one in frames]
        assert [unit.size_bytes for unit in source.camera_stream.units] == sizes
    assert [frame.index for frame in frames] == list(range(45))
    times = [frame.capture_ns - SECOND_NS for frame in frames]
    assert times == pytest.approx([index * SECOND_NS / 20 for index in range(45)], abs=1e6)
    decoder = BaseDecoder()
    assert all(np.array_equal(decoder.decode(one.camera_unit.data), one.base_bgr) for one in frames)
    slices = [[nal for nal in nal_units(one.camera_unit.data) if nal_kind(nal) < 32] for one in frames]
    assert slices == pictures_of(clip)


def test_a_clip_may_be_played_at_another_rate_and_again(tmp_path):
    """A raw stream that says no rate would play at any, or a second reading begin in the middle."""
    with coded(write_clip(tmp_path / "a.hevc"), source_fps=5, max_frames=12) as source:
        first, again = (list(source.frames(start_ns=0)) for _ in range(2))
    assert source.fps == 5
    assert [frame.capture_ns for frame in first] == [index * SECOND_NS // 5 for index in range(12)]
    assert [one.camera_unit for one in first] == [one.camera_unit for one in again]


def test_what_an_edit_list_hides_is_said_to_be_sent(tmp_path):
    """A clip that was trimmed without being coded anew begins earlier than its poses."""
    whole = write_clip(tmp_path / "whole.mp4")
    copied([(whole, lambda packet: -4 * packet.duration)], tmp_path / "a.mp4")
    with coded(tmp_path / "a.mp4") as source:
        assert "hides 4 of its pictures" in " ".join(source.notes)


def test_what_is_damaged_is_left_out_up_to_the_next_keyframe(tmp_path, caplog):
    """Garbage would be shown as if the camera had seen it."""
    packets = packets_of(write_clip(tmp_path / "a.hevc"))
    packets[13] = packets[13][:8]
    clip = tmp_path / "damaged.hevc"
    clip.write_bytes(b"".join(packets))
    with coded(clip) as source:
        frames = list(source.frames(start_ns=0))
    played = [frame.index for frame in frames]
    assert played[:13] == list(range(13))
    (gap,) = ((one, two) for one, two in pairwise(frames) if two.index != one.index + 1)
    assert gap[1].camera_unit.keyframe
    assert len(frames) == 45 - 7
    assert "units could not be passed on" in caplog.text


@pytest.mark.parametrize(
    ("made", "size", "says"),
    [
        ({"bframes": 3}, None, r"in another order than it sends them \(B-frames\)"),
        (
            {"pixel_format": "yuv420p10le"},
            None,
            "is HEVC Main 10 in yuv420p10le, and .* takes Main, 4:2:0 in 8",
        ),
        ({"pixel_format": "yuv444p"}, None, "yuv444p, and .* takes Main"),
        ({"codec": "libx264"}, None, "is h264, and --encoder passthrough takes HEVC alone"),
        ({"more": "sar=10"}, None, "has pixels that are 1.64 times as wide as high"),
        ({}, (640, 360), r"is 320x192, --size is 640x360, and .* sends the camera's own size"),
        ("demo", None, "is the drawn demo, and --encoder passthrough takes a video file or a stream"),
        ("/dev/video0", None, "is a device, and --encoder passthrough takes a video file or a stream"),
        ("/dev/" + "x" * 300, None, "is a device, and"),
        ("x" * 300, None, "does not exist"),
        (".", None, "is a folder, and --encoder passthrough takes a video file or a stream"),
    ],
)
def test_what_no_ground_could_show_is_refused(tmp_path, made, size, says):
    """A flight would begin that shows nothing, or another picture than the camera's."""
    spec = made if isinstance(made, str) else write_clip(tmp_path / "a.mp4", **made)
    with pytest.raises(UserError, match=says) as caught:
        coded(spec, size=size)
    advised = "re-encode it with --encoder x265" in str(caught.value)
    assert advised == (says != "does not exist")


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("range=full:colormatrix=bt709", "is not BT.709 in limited range"),
        ("interlace=tff", "is interlaced"),
        ("range=limited:colormatrix=bt709", ""),
    ],
)
def test_what_grounds_show_a_little_off_is_told_of(tmp_path, more, says):
    """Who sees grey for black, or combs, would look for the fault in the camera."""
    with coded(write_clip(tmp_path / "a.mp4", more=more)) as source:
        assert says in source.warning
        assert bool(says) == bool(source.warning)


def jumping(clip: Path, *, ahead: bool) -> Path:
    """The clip twice over; in the middle its time begins anew, or is ``ahead`` by a day."""
    twice = clip.with_name("twice.ts" if not ahead else "twice.mkv")
    if ahead:
        day = lambda packet: round(86_400 / packet.time_base)  # noqa: E731
        return copied([(clip, lambda _: 0), (clip, day)], twice)
    twice.write_bytes(2 * clip.read_bytes())
    return twice


@pytest.mark.parametrize("ahead", [False, True])
def test_time_stamps_that_jump_change_neither_rate_nor_window(tmp_path, ahead):
    """A camera would be refused for a window that it never fills, or said to make one keyframe a day."""
    clip = write_clip(tmp_path / "a.ts")
    once, both = (coded(path).camera_stream for path in (clip, jumping(clip, ahead=ahead)))
    assert len(both.units) == 2 * len(once.units), "all of it is looked at"
    assert both.fps == once.fps
    assert both.keyframe_s == pytest.approx(once.keyframe_s, abs=0.01)
    with coded(jumping(clip, ahead=ahead)) as source:
        times = [frame.capture_ns for frame in source.frames(start_ns=0)]
    assert len(times) == len(both.units)
    assert max(later - earlier for earlier, later in pairwise(times)) < SECOND_NS / 10, "in flight too"
    fullest = [measure_camera(one, window_s=0.99, edge_id="edge-1").window_bytes for one in (once, both)]
    assert fullest[1] == pytest.approx(fullest[0], rel=0.2)


@pytest.mark.parametrize("jump_s", [2.0, 95_443.7, -1.5, -95_443.7])
@pytest.mark.parametrize(("said", "fps"), [(None, 25.0), (25.0, 25.0), (5.0, 25.0)])
def test_the_rate_is_that_between_the_jumps(jump_s, said, fps):
    """A clock that runs over in the first seconds would be a camera of one frame an hour."""
    seen = [SeenUnit(index / 25 + jump_s * (index > 50), 3000, index % 50 == 0) for index in range(100)]
    assert rate_of("cam", seen, said=said) == pytest.approx(fps)
    mended = without_jumps(seen)
    assert [one.at_s for one in mended] == pytest.approx([index / 25 for index in range(100)])


def test_a_slow_camera_has_no_jumps():
    """One frame each two seconds would be taken for something else."""
    seen = [SeenUnit(2.0 * index, 3000, keyframe=True) for index in range(10)]
    assert rate_of("cam", seen, said=None) == 0.5


@pytest.fixture(scope="module")
def units(tmp_path_factory) -> list[bytes]:
    """Two seconds of a camera at 25 fps."""
    folder = tmp_path_factory.mktemp("units")
    return packets_of(write_clip(folder / "a.hevc", smooth_pictures(50, size=SIZE), fps=25, keyint=25))


def test_no_unit_of_a_live_camera_is_lost(free_port, units, monkeypatch):
    """Each one that is missing is a picture that stands still up to the next keyframe."""
    monkeypatch.setattr(coded_source, "QUEUE_S", 60.0)  # this machine may be busy for seconds
    even = count(SECOND_NS, SECOND_NS // 25).__next__
    with RtspCamera(free_port, units=units, clock_ns=even) as camera, coded(camera.url) as source:
        assert source.live
        assert source.fps == pytest.approx(25, rel=0.15)
        assert source.camera_stream.keyframe_s == pytest.approx(1, rel=0.3)
        frames = []
        for frame in source.frames(start_ns=0):
            frames.append(frame)
            if len(frames) == 20:
                time.sleep(0.6)  # as where a unit waits for its room
            if len(frames) == 70:
                break
    assert [frame.index for frame in frames] == list(range(70))
    assert frames[0].camera_unit.keyframe
    assert all(later.capture_ns > earlier.capture_ns for earlier, later in pairwise(frames))
    assert parameter_sets(frames[0].camera_unit.data), "the camera sends them in its description alone"
    decoder = BaseDecoder(size=SIZE)
    assert all(np.array_equal(decoder.decode(one.camera_unit.data), one.base_bgr) for one in frames)


def test_a_reader_that_is_away_for_long_goes_on_with_a_keyframe(free_port, units):
    """The queue would grow for ever, or what follows be garbage."""
    with RtspCamera(free_port, units=units) as camera, coded(camera.url) as source:
        frames = source.frames(start_ns=0)
        before = next(frames)
        eventually(lambda: source.missed >= 60)
        shown = [next(frames) for _ in range(60)]
        gap = next(two for one, two in pairwise([before, *shown]) if two.index != one.index + 1)
        assert gap.camera_unit.keyframe
        decoder = BaseDecoder(size=SIZE)
        assert all(decoder.decode(one.camera_unit.data) is not None for one in shown[shown.index(gap) :])


def test_a_camera_that_restarts_goes_on_with_a_keyframe_and_one_that_changed_is_told_of(
    free_port, units, tmp_path
):
    """After a camera's reboot the picture would be garbage, or of a size that the ground does not take."""
    larger = packets_of(write_clip(tmp_path / "a.hevc", hard_pictures(25, size=(384, 256)), fps=25))
    failures = Failures(time.time_ns)
    camera = RtspCamera(free_port, units=units)
    try:
        with coded(camera.url, failures=failures) as source:
            frames, gaps, restarted = [], [], 0
            for frame in source.steps(start_ns=0):
                if frame is not None:
                    frames.append(frame)
                    if len(frames) > 1 and frame.index != frames[-2].index + 1:
                        gaps.append(frame)
                if len(frames) == 10 and not restarted:
                    camera.close()
                    camera, restarted = RtspCamera(free_port, units=larger), 1
                said = [one.reason for one in failures.parts]
                if restarted == 1 and any("384x256" in one for one in said):
                    camera.close()
                    camera, restarted = RtspCamera(free_port, units=units), 2
                if restarted == 2 and gaps and len(frames) > 20:
                    break
        assert gaps
        assert gaps[0].camera_unit.keyframe
        assert {frame.base_bgr.shape for frame in frames} == {(SIZE[1], SIZE[0], 3)}
        (part,) = failures.parts
        assert (part.part, part.working) == ("source", True)
    finally:
        camera.close()


class Turning(CodedStreamGrabber):
    """A camera that has another picture size from some packet on, within one connection."""

    def __init__(self, packets: list[bytes]) -> None:
        self.name, self.said_fps = "cam", 25.0
        self._left, self._decoder = iter(enumerate(packets)), CameraDecoder(CameraUnits(b""))

    def open(self) -> None:
        """It is open."""

    close = open  # noqa: A003 - the method above

    def grab(self) -> Shot:
        time.sleep(0.04)
        number, packet = next(self._left, (0, b""))
        if not packet:
            raise SignalLost("it ended")
        return Shot(partial(np.zeros, (2, 2, 3)), None, CameraPacket(packet, number / 25, self._decoder))

    def restart(self) -> None:
        raise SignalLost("it is gone")


@pytest.mark.parametrize("other", [(384, 256), (192, 128)])
def test_a_clip_that_goes_on_in_another_size_says_so(tmp_path, caplog, other):
    """Of a larger one it was said that it is damaged; a camera that came back so was waited for without end."""
    parts = [
        write_clip(tmp_path / f"{size[0]}.hevc", hard_pictures(10, size=size), fps=25)
        for size in (SIZE, other)
    ]
    (tmp_path / "a.hevc").write_bytes(b"".join(one.read_bytes() for one in parts))
    with coded(tmp_path / "a.hevc") as source:
        assert len(list(source.frames(start_ns=0))) == 10
    assert f"10 units could not be passed on (a picture has {other[0]}x{other[1]} pixels)" in caplog.text


@pytest.mark.parametrize("other", [(384, 256), (192, 128)])
def test_a_picture_size_that_changes_within_the_first_connection_is_told_of(units, tmp_path, other):
    """The ground would get pictures of a size that it does not take, and boxes that belong nowhere."""
    turned = packets_of(write_clip(tmp_path / "a.hevc", hard_pictures(25, size=other), fps=25))
    failures = Failures(time.time_ns)
    grabber, told = Turning([*units, *units, *turned]), False
    decoder, shown = BaseDecoder(), []
    with CodedLiveSource(grabber, SETTINGS, failures=failures) as source:
        for frame in source.steps(start_ns=0):
            shown += [] if frame is None else [decoder.decode(frame.camera_unit.data)]
            said = [one.reason for one in failures.parts]
            told = told or any(f"a picture has {other[0]}x{other[1]} pixels" in one for one in said)
            if told or any("it ended" in one or "it is gone" in one for one in said):
                break
    assert len(shown) > 10
    assert {picture.shape for picture in shown} == {(SIZE[1], SIZE[0], 3)}
    assert told


def test_a_camera_that_stays_with_another_size_ends_the_flight(units, tmp_path, monkeypatch):
    """The edge went on without a picture for ever, though a new start would have taken the camera as it is now."""
    monkeypatch.setattr(coded_source, "MOST_OTHER_NS", 4 * 10**8)
    turned = packets_of(write_clip(tmp_path / "a.hevc", hard_pictures(25, size=(384, 256)), fps=25))
    ends = pytest.raises(FlightError, match="a picture has 384x256 pixels")
    with CodedLiveSource(Turning([*units, *units, *turned]), SETTINGS) as source, ends:
        all(True for _ in source.steps(start_ns=0))
