"""The rungs of the live picture, from a real base stream."""

import io
import struct
from dataclasses import replace
from unittest.mock import MagicMock

import av
import cv2
import numpy as np
import pytest

from hvt_ground.events import VideoSample
from hvt_web.feed import SessionFeed
from hvt_web.video.fmp4 import Fragment, Muxer, Start
from hvt_web.video.pictures import Pictures
from hvt_web.viewers import EdgePage
from media.moving_square import FPS, SIZE, STEP_PX, moving_square
from rigs.examples import refinement
from rigs.messages import INFO, PLAIN


@pytest.fixture(scope="module")
def samples() -> list[VideoSample]:
    """Four seconds of a square that moves, one keyframe."""
    return [
        VideoSample(index, 10**18 + index * 10**9 // FPS, data, keyframe)
        for index, (data, keyframe) in enumerate(moving_square("libx265", 60))
    ]


def pictures() -> Pictures:
    return Pictures(replace(INFO, base_size=SIZE, source_size=SIZE, fps=FPS))


def fed(made: Pictures, samples, rungs, *, hurry=False, number=1) -> list:
    wanted = dict.fromkeys(rungs, number)
    return [
        one
        for sample in samples
        for one in made.add(sample, wanted=wanted, now_ns=sample.capture_ns, hurry=hurry)
    ]


def shown(made) -> list[np.ndarray]:
    """What a player shows of a start and fragments."""
    data = b"".join(one.item.data for one in made)
    with av.open(io.BytesIO(data), format="mp4") as container:
        return [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]


def place(picture: np.ndarray) -> int:
    """The left side of the square."""
    return int(np.argmax(picture[70, :, 1] > 130))


@pytest.mark.parametrize("rung", ["hevc", "h264"])
def test_each_picture_is_given_out_at_once(samples, rung):
    """The page would show every picture one later."""
    made = pictures()
    for index, sample in enumerate(samples):
        came = fed(made, [sample], {rung})
        assert len([one for one in came if isinstance(one.item, Fragment)]) == 1
        assert isinstance(came[0].item, Start) == (index == 0)


@pytest.mark.parametrize(("rung", "count"), [("hevc", 31), ("h264", 30)])
def test_who_begins_to_look_in_the_middle_sees_the_picture_of_now(samples, rung, count):
    """He would wait for the next keyframe, which may be a minute away."""
    made = pictures()
    assert fed(made, samples[:30], set()) == []
    came = fed(made, samples[30:], {rung})
    seen = shown(came)
    assert len(seen) == (60 if rung == "hevc" else 30)
    assert count <= len(seen)
    assert [place(one) for one in seen[-30:]] == pytest.approx(
        [index * STEP_PX for index in range(30, 60)], abs=2
    )


def test_who_looks_goes_on_however_rare_keyframes_are(samples, monkeypatch):
    """With keyframes on demand alone the page would stand still for good after two minutes."""
    monkeypatch.setattr("hvt_web.video.pictures.MOST_GOP_UNITS", 10)
    for rung in ("hevc", "h264"):
        assert [place(one) for one in shown(fed(pictures(), samples, {rung}))] == pytest.approx(
            [index * STEP_PX for index in range(60)], abs=2
        )
    made = pictures()
    fed(made, samples[:30], set())
    assert fed(made, samples[30:], {"hevc", "h264", "jpeg"}) == []  # their keyframe is no longer kept
    assert fed(made, samples[:3], {"hevc"}, number=2)


def test_who_begins_to_look_where_no_keyframe_comes_by_itself_has_one_asked_for(samples, monkeypatch):
    """With --keyframe-interval 0 the page would wait for one for good."""
    monkeypatch.setattr("hvt_web.video.pictures.MOST_GOP_UNITS", 10)
    now_ns, page = samples[0].capture_ns, EdgePage("uav-1")
    info = replace(INFO, base_size=SIZE, source_size=SIZE, fps=FPS, pace="realtime")
    sink = SessionFeed(info, page, MagicMock(), clock=lambda: now_ns)

    def asks(some: list[VideoSample]) -> list[int]:
        nonlocal now_ns
        asked = []
        for sample in some:
            now_ns = sample.capture_ns
            sink.log(sample)
            asked += [sample.frame_index] * sink.awaits_keyframe
            sink.awaits_keyframe = False
        return asked

    assert asks(samples[:20]) == [], "nobody looks"
    page.wanted = {"hevc": 1}
    assert asks(samples[20:]) == [20, 20 + 2 * FPS]
    assert asks(samples[:5]) == [], "it has come"


def test_keyframes_of_the_coded_stream_come_every_two_seconds(samples):
    """Who joins would decode everything since the first one looked."""
    came = [one.item for one in fed(pictures(), samples, {"h264"}) if isinstance(one.item, Fragment)]
    keyframes = [index for index, one in enumerate(came) if one.keyframe]
    assert keyframes[:2] == [0, 30]


def test_single_pictures_come_twice_a_second_and_thumbnails_once(samples):
    """A thin browser would be given all pictures, or none."""
    came = fed(pictures(), samples, {"jpeg", "thumbnail"})
    jpegs = [one.item for one in came if one.rung == "jpeg"]
    assert len(jpegs) == 8
    assert len([one for one in came if one.rung == "thumbnail"]) == 4
    assert cv2.imdecode(np.frombuffer(jpegs[-1], np.uint8), cv2.IMREAD_COLOR).shape == (SIZE[1], SIZE[0], 3)


def test_the_last_picture_is_made_for_who_comes_after_it(samples):
    """The page of an edge that nobody had looked at was empty during an outage."""
    made = pictures()
    fed(made, samples[:20], set())
    made.close()
    [(sample, (single, thumbnail))] = made.last()
    assert (sample, single.rung, thumbnail.rung) == (samples[19], "jpeg", "thumbnail")
    assert isinstance(single.item, bytes)
    shown_last = cv2.imdecode(np.frombuffer(single.item, np.uint8), cv2.IMREAD_COLOR)
    assert place(shown_last) == pytest.approx(19 * STEP_PX, abs=2)
    made.gap()
    assert not list(made.last()), "a picture without its keyframe would be grey"


def test_after_a_gap_nothing_comes_before_the_keyframe(samples):
    """The page would show a broken picture."""
    made = pictures()
    fed(made, samples[:20], {"h264", "hevc"})
    made.gap()
    assert fed(made, samples[25:40], {"h264", "hevc", "jpeg"}) == []
    again = [replace(one, frame_index=100 + one.frame_index) for one in samples[:10]]
    came = fed(made, again, {"h264", "hevc"})
    assert {one.rung for one in came} == {"h264", "hevc"}
    assert [place(one) for one in shown([one for one in came if one.rung == "hevc"])][-1] == pytest.approx(
        36, abs=2
    )


def test_in_a_hurry_pictures_are_decoded_and_not_coded_again(samples):
    """On a slow machine the page would fall behind more and more."""
    made = pictures()
    fed(made, samples[:10], {"h264"})
    assert fed(made, samples[10:20], {"h264"}, hurry=True) == []
    assert len(fed(made, samples[20:30], {"h264"})) == 10


def test_garbage_ends_nothing(samples):
    """One damaged unit would take the page of an edge away."""
    made = pictures()
    fed(made, samples[:5], {"h264", "hevc"})
    broken = replace(samples[5], data=b"\0\0\1" + bytes(range(200)))
    fed(made, [broken, replace(samples[6], data=b"")], {"h264", "hevc"})
    came = fed(made, samples, {"h264"}, number=2)
    assert len(shown(came)) >= 59


def test_a_still_is_called_as_its_box_is_and_has_the_time_of_its_frame():
    """The strip said truck beside a box that said vehicle, and when the still was read."""
    hub = MagicMock(post=lambda act: act())
    feed = SessionFeed(INFO, EdgePage("uav-1"), hub, clock=lambda: 0)
    feed.log(refinement(class_after="truck", vague=(False, True), header=replace(PLAIN, frame_index=7)))
    _, message, _ = hub.still.call_args.args
    assert '"before":"car","after":"vehicle"' in message
    assert '"frame":7' in message


@pytest.mark.parametrize(("codec", "kind"), [("libx264", "h264"), ("libx265", "hevc")])
def test_every_picture_comes_back_from_the_fragments(codec, kind):
    """A browser would show nothing, or half."""
    muxer = Muxer(kind, size=SIZE, fps=FPS)
    given = moving_square(codec, 20)
    out = io.BytesIO()
    starts = []
    for index, (data, keyframe) in enumerate(given):
        start, fragment = muxer.add(data, keyframe=keyframe, capture_ns=index * 10**9 // FPS)
        if start:
            starts.append(start.codec)
            out.write(start.data)
        assert fragment is not None
        assert fragment.keyframe == keyframe
        out.write(fragment.data)
    assert len(starts) == 1
    assert starts[0].startswith({"h264": "avc1.42", "hevc": "hvc1.1.6.L"}[kind])
    out.seek(0)
    with av.open(out, format="mp4") as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == kind
        frames = list(container.decode(video=0))
    assert len(frames) == len(given)
    assert (frames[0].width, frames[0].height) == SIZE
    track = out.getvalue().index(b"tkhd")  # players that lay out a page by the track would stretch it
    assert struct.unpack_from(">HxxH", out.getvalue(), track + 80) == SIZE
    times = [frame.time for frame in frames]
    assert times == pytest.approx([index / FPS for index in range(len(given))], abs=1e-3)


def test_the_timeline_has_no_holes_where_pictures_are_missing():
    """A browser stops at a hole, and would show nothing more."""
    muxer = Muxer("h264", size=SIZE, fps=FPS)
    ends = 0.0
    for index, (data, keyframe) in enumerate(moving_square("libx264", 20)):
        late_ns = 3 * 10**9 if index > 10 else 0
        _, fragment = muxer.add(data, keyframe=keyframe, capture_ns=late_ns + index * 10**9 // FPS)
        assert fragment.media_s == pytest.approx(ends, abs=1e-4)
        ends = fragment.media_s + fragment.duration_s
    assert ends < 2.0


def test_nothing_comes_before_parameter_sets():
    """A player cannot begin without them."""
    muxer = Muxer("h264", size=SIZE, fps=FPS)
    later = moving_square("libx264", 20)[1]
    assert muxer.add(later[0], keyframe=False, capture_ns=0) == (None, None)
    assert muxer.add(b"nonsense", keyframe=True, capture_ns=0) == (None, None)
