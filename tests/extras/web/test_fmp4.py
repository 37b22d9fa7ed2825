"""Fragmented MP4: what the page plays is what came over the link."""

from __future__ import annotations

import io

import av
import pytest

from hvt_web.video.fmp4 import Muxer
from media.moving_square import FPS, SIZE, moving_square


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
