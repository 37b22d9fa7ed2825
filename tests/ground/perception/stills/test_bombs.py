"""Small messages that would be large pictures: refused by their headers, before memory is taken for them.

Each bomb is decoded in a process of its own, which says by how much its peak of memory rose. The bounds are generous:
a bomb that went off would take hundreds of megabytes.
"""

import io
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

from hvt_codecs.avif import av1_data, avif_file
from hvt_common.protocol.messages import RoiHeader, WireError
from hvt_common.protocol.messages.bits import BitWriter
from hvt_common.values import View
from hvt_common.video.hevc import BaseDecoder
from hvt_common.video.still_codecs import JpegCodec, StillError, still_codec, still_codec_names
from hvt_common.video.still_codecs.h264_intra import parameter_sets
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from hvt_ground.perception.stills.decode import ReceivedStill, decode_still
from media.clips import framed
from media.crops import textured
from media.hevc_pictures import coded_picture
from rigs.flight import Flight
from rigs.messages import ROI

SIZE = (56, 40)
_MOST_MB = 48

_MEASURED = """
import pickle, resource, sys
sys.path[:0] = sys.argv[1:]
*given, good, bombs = pickle.load(sys.stdin.buffer)
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
{}
before = peak()
count = sum(map(shown, bombs))
{}
print((peak() - before) // 1024, count)
"""
_STILLS = _MEASURED.format(
    """
from hvt_common.video.still_codecs import StillError, still_codec
name, size = given
codec = still_codec(name)
def shown(data):
    try:
        return codec.decode(data, size=size) is not None
    except StillError:
        return False
assert shown(good)
""",
    "",
)
_SESSION = _MEASURED.format(
    """
import time
from dataclasses import replace
from rigs.flight import Flight, pipeline_of
from hvt_common.protocol.messages import BaseHeader
from hvt_ground.link.reassemble import Arrival
from hvt_ground.session.session import Session
flight = Flight(2)
first = flight.base(0)
header = BaseHeader.parse(first.attachment, first.payload)
session = Session(flight.info(), pipeline_of=pipeline_of, clock=time.time_ns)
def shown(data):
    unit = replace(header, frame_index=shown.count), replace(first, payload=data)
    shown.count += 1
    return session.base(Arrival("decode", *unit, first.received_ns, starts_run=True))
shown.count = 0
assert shown(first.payload)
""",
    "session.close()",
)
_PAST = _MEASURED.format(
    """
from hvt_common.protocol.messages import BacklogUnit
from hvt_ground.backlog.session_backlog import BacklogVideo
video = BacklogVideo(base_size=given[0])
def shown(data):
    units = [BacklogUnit(shown.count, shown.count, True, data)]
    shown.count += 1
    return sum(one is not None and one[1] is not None for one in video.pictures(units))
shown.count = 0
assert shown(good)
""",
    "",
)
_BASE = _MEASURED.format(
    """
from hvt_common.video.hevc import BaseDecoder
decoder = BaseDecoder(size=given[0])
def shown(data):
    return decoder.decode(data) is not None
assert shown(good)
""",
    "decoder.reset(); assert shown(good)",
)


def defused(script: str, *values: object) -> int:
    """How many bombs a process showed that was given these values; its peak of memory did not rise for them."""
    command = [sys.executable, "-c", script, str(Path(__file__).parents[4] / "tests" / "support")]
    ended = subprocess.run(command, input=pickle.dumps(values), stdout=subprocess.PIPE, check=True)
    risen_mb, count = map(int, ended.stdout.split()[-2:])
    assert risen_mb < _MOST_MB
    return count


def saved(kind: str, size: tuple[int, int], **options) -> bytes:
    """A picture of one colour as Pillow writes it: a large one is a small file."""
    buffer = io.BytesIO()
    Pillow.new("RGB", size, (40, 90, 160)).save(buffer, kind, **options)
    return buffer.getvalue()


def jpeg_bombs() -> list[bytes]:
    """A real picture of many pixels, one whose header says 65500x65500, and scans without number."""
    large = saved("JPEG", (6000, 6000), quality=10)
    header = large.index(b"\xff\xc0") + 5
    largest = large[:header] + (65500).to_bytes(2, "big") * 2 + large[header + 4 :]
    small = cv2.imencode(".jpg", textured(*SIZE))[1].tobytes()
    scan = b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00"
    scans = small[: small.index(b"\xff\xda")] + scan * 50_000 + b"\xff\xd9"
    behind = small[:-2] + b"\xff\xda\x00\x0c\x03\x01\x00\x02\x11\x03\x11\x00\x3f\x00" * 50_000 + b"\xff\xd9"
    disguised = b"\xff\xd8" + largest[2:header] + largest[header:]
    progressive = saved("JPEG", SIZE, quality=10, progressive=True)
    return [large, largest, scans, behind, disguised, progressive]


def webp_bombs() -> list[bytes]:
    """A lossy picture of 16383x16383 by its header, a lossless one, one with an extended header."""
    small = saved("WEBP", SIZE, quality=50)
    largest = small[:26] + (16383).to_bytes(2, "little") * 2 + small[30:]
    extended = bytearray(saved("WEBP", SIZE, quality=50, icc_profile=b"x" * 20))
    at = extended.index(b"VP8X") + 12
    extended[at : at + 6] = (16382).to_bytes(3, "little") * 2
    return [largest, saved("WEBP", (4000, 4000), lossless=True), bytes(extended)]


def avif_bombs() -> list[bytes]:
    """A real picture of many pixels, AV1 data that says another size than the boxes, and as large a one as can be."""
    large = cv2.imencode(".avif", np.full((3000, 3000, 3), 90, np.uint8))[1].tobytes()
    lying = avif_file(av1_data(large), size=SIZE)
    return [large, lying, avif_file(av1_announced(65536), size=SIZE)]


def av1_announced(side: int) -> bytes:
    """AV1 data whose sequence header announces a square picture: 16 bits for each side."""
    header = BitWriter().u(0b00011, 5).u(0, 5).u(15, 4).u(15, 4).u(side - 1, 16).u(side - 1, 16).ended()
    return b"\x0a" + bytes([len(header)]) + header + b"\x32\x10" + bytes(16)


def jxl_bombs() -> list[bytes]:
    """A real picture of many pixels, and the header of one of 2^30 pixels a side."""
    from pillow_jxl import Encoder

    pixels = np.full((3000, 3000, 3), 90, np.uint8)
    encoder = Encoder(mode="RGB", lossless=False, quality=50, decoding_speed=0, effort=3, use_container=False)
    large = encoder(pixels.tobytes(), 3000, 3000, jpeg_encode=False)
    side = 0b11 | (2**30 - 1) << 2
    announced = (side << 1 | side << 36).to_bytes(12, "little")
    return [large, b"\xff\x0a" + announced + large[14:]]


BOMBS = {"jpeg": jpeg_bombs, "webp": webp_bombs, "avif": avif_bombs, "jxl": jxl_bombs}


@pytest.mark.parametrize("name", BOMBS)
def test_a_still_that_says_another_size_costs_nothing(name):
    """A few kilobytes would make the ground take gigabytes, or minutes."""
    if name not in still_codec_names():
        pytest.skip(f"{name} is not installed")
    codec, bombs = still_codec(name), BOMBS[name]()
    good = codec.encode(textured(*SIZE), quality_pct=60).data
    assert defused(_STILLS, name, SIZE, good, bombs) == 0


@pytest.mark.skipif("avif" not in still_codec_names(), reason="OpenCV without AVIF")
def test_boxes_that_announce_a_huge_avif_do_not_count():
    """A decoder that believes the boxes takes memory for 16384x16384 pixels; ours gets boxes of our own."""
    codec = still_codec("avif")
    good = codec.encode(textured(*SIZE), quality_pct=60).data
    at = good.index(b"ispe") + 8
    bomb = good[:at] + (16384).to_bytes(4, "big") * 2 + good[at + 8 :]
    assert np.array_equal(codec.decode(bomb, size=SIZE), codec.decode(good, size=SIZE))
    assert defused(_STILLS, "avif", SIZE, good, [bomb] * 4) == 4


def test_parameter_sets_inside_a_slice_do_not_count():
    """The slice is said to be of one size, and brings along the header of another."""
    good = still_codec("h264-intra").encode(textured(*SIZE), quality_pct=60).data
    announced = parameter_sets((8192, 8192)) + coded_picture(b"\x80" * 9, size=(8192, 8192), qp=30)
    bombs = [good[:1] + announced, good[:1] + announced + good[1:], good + announced]
    defused(_STILLS, "h264-intra", SIZE, good, bombs)


@pytest.mark.parametrize(
    ("script", "known", "size"),
    [
        *((_BASE, (640, 360), size) for size in ((8192, 4320), (8192, 8192), (16384, 16384), (16384, 64))),
        (_SESSION, None, (8192, 4320)),  # the bound would be there, and nobody say to the decoder what it is
        (_PAST, (640, 384), (8192, 4320)),  # the same message would go off, sent as one of an outage
    ],
)
def test_parameter_sets_of_the_base_that_announce_a_huge_picture_cost_nothing(script, known, size):
    """One message would take 200 to 400 MB at the ground, and sixteen kept references many times that."""
    good = coded_picture(b"\x80" * 20, size=(640, 384), qp=30)
    bomb = coded_picture(b"\x80" * 20, size=size, qp=30)
    assert len(bomb) < 150
    assert defused(script, known, good, [bomb] * 8) == 0


def test_without_a_size_the_base_takes_what_hevc_has_and_no_more():
    """A study or a tool that knows no size would fill the memory."""
    decoder = BaseDecoder()
    assert decoder.decode(coded_picture(b"\x80" * 20, size=(8192, 4400), qp=30)) is None
    assert decoder.decode(coded_picture(b"\x80" * 20, size=(1920, 1088), qp=30)).shape == (1088, 1920, 3)


@pytest.mark.parametrize("size", [(320, 180), (1280, 720), (322, 178), (64, 64)])
def test_a_base_of_the_announced_size_is_shown_whatever_fills_it_up(size):
    """Sizes that are no multiple of a block would stay dark."""
    encoder = BaseEncoder(EncoderSettings(size=size, fps=15, bitrate_bps=300_000, preset="ultrafast"))
    (frame,) = framed([np.full((size[1], size[0], 3), 90, np.uint8)])
    assert BaseDecoder(size=size).decode(encoder.encode(frame).data).shape == (size[1], size[0], 3)


@pytest.mark.parametrize(("scale", "good"), [(1.0, True), (40.0, False), (1e4, False)])
def test_a_scale_that_no_picture_has_costs_nothing(scale, good):
    """An `Info` of a stranger would have each pixel of a still be the mean of a hundred million samples."""
    flight = Flight(1)
    picture = BaseDecoder().decode_yuv(flight.base(0).payload)
    assert picture is not None
    view = replace(flight.info().view, scale=scale, source_size=(4096, 4096))
    size = {"w": 64, "h": 64} if scale > 1 else {}
    header = replace(ROI, codec="residual", crop_source_px=(0, 0, 64, 64), parameters=size)
    with pytest.raises(StillError, match="another base picture" if good else "far smaller"):
        decode_still(ReceivedStill(header, b"\x20still"), base=picture, view=view)


def test_a_plain_picture_may_be_as_small_as_it_likes():
    """A thumbnail of a 4K frame would be refused for a cost that only what builds on the base has."""
    view = View.fitted((3840, 2160), (1280, 720), fit="letterbox")
    header = replace(ROI, codec="jpeg", crop_source_px=(0, 0, 3840, 2160), parameters={"w": 32, "h": 18})
    coded = JpegCodec().encode(np.full((18, 32, 3), 90, np.uint8), quality_pct=65)
    assert decode_still(ReceivedStill(header, coded.data), base=None, view=view).shape == (18, 32, 3)


def test_a_still_of_more_bytes_than_any_has_is_not_taken():
    """A few hundred of them in a queue would be a gigabyte."""
    header = replace(ROI, also=())
    largest = bytes(RoiHeader.MAX_PAYLOAD)
    assert RoiHeader.parse(header.pack(largest), largest) == header
    with pytest.raises(WireError, match="longer than"):
        RoiHeader.parse(header.pack(b""), largest + b"\0")


def test_a_broken_picture_says_nothing_on_stderr(capfd):
    """Whoever sends them by the thousand would fill the log: OpenCV has a line for each."""
    if "avif" not in still_codec_names():
        pytest.skip("OpenCV without AVIF")
    file = still_codec("avif").encode(textured(*SIZE), quality_pct=60).data
    for at in range(40):
        broken = bytearray(file)
        broken[-1 - at] ^= 0xFF
        try:
            still_codec("avif").decode(bytes(broken), size=SIZE)
        except StillError:
            continue
    assert capfd.readouterr().err == ""
