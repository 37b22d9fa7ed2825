"""Clips as cameras, recorders and phones leave them, against what a player shows."""

import gc
import logging
import shutil
import struct
import threading
from fractions import Fraction
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition
from PIL import Image

from hvt_common.errors import UserError
from hvt_edge.source.decoding import container
from hvt_edge.source.opening import open_source
from media.numbered import copied, disc, number_of, numbered, patch, write_numbered
from programs.processes import PATIENT_S


def play(spec, *, fps=30.0, **settings):
    """Play it at the source's own size; returns the source and its pictures."""
    with open_source(str(spec), size=lambda size: size, fps=fps, **settings) as source:
        return source, [frame.source_bgr for frame in source.frames(start_ns=0)]


def numbers(pictures):
    return [number_of(one) for one in pictures]


# -- time -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "made", "fps", "shown", "says"),
    [
        # AVI says no time of presentation: half of the frames would be left out, and the rest judder.
        (
            "a.avi",
            {"bf": "3", "x264-params": "b-adapt=0"},
            30,
            range(60),
            "time stamps of the decoding alone",
        ),
        # Each third frame of a Matroska recording that was put into an MP4 as it is was lost, others shown twice.
        ("a.mp4", {"times_ms": [round(one * 1000 / 30) for one in range(60)], "bf": "0"}, 30, range(60), ""),
        # Each time-lapse would be called unfinished: the last to be decoded is two pictures before the end.
        *(
            (name, {"rate": Fraction(1, 5), "bf": "3", "x264-params": "b-adapt=0"}, 0.2, range(60), "")
            for name in ("slow.mp4", "slow.mkv")
        ),
        # Broken encoders invent such matrices: one ended the flight with the operating system's error.
        (
            "a.mkv",
            {"x264-params": "colormatrix=YCgCo"},
            30,
            range(60),
            "it says colour matrix 8, which FFmpeg lacks: BT.601",
        ),
        # A recording of JPEGs in a row, 30 a second, lasted longer, without a word.
        (
            "a.mjpeg",
            {"codec": "mjpeg", "pixels": "yuvj420p"},
            25,
            range(60),
            "25 frames a second, which is a guess",
        ),
        # FFmpeg takes 25 frames a second for any.
        ("a.h264", {}, 30, range(60), "30 frames a second, as the stream itself says"),
        ("a.hevc", {"codec": "libx265"}, 30, range(60), "30 frames a second, as the stream itself says"),
        # Encoders that were told no rate write their clock (picamera#541): the log called it the stream's own 25.
        ("a.h264", {"rate": 500}, 25, range(60), "25 frames a second, which is a guess"),
        # Of a film whose header has its clock in place of its rate, two pictures were shown, without a word.
        (
            "a.mkv",
            {"times_ms": range(60), "bf": "0"},
            30,
            (1, 34),
            "1000 frames a second, of which most are left out; --source-fps N",
        ),
    ],
)
def test_a_film_runs_at_its_own_rate_and_guesses_are_said(tmp_path, caplog, name, made, fps, shown, says):
    """It would be slow, judder, or lose frames, and nobody be told why."""
    source, pictures = play(write_numbered(tmp_path / name, 60, **made), fps=fps)
    assert numbers(pictures) == list(shown)
    assert says in " ".join(source.notes)
    assert "unfinished" not in caplog.text


@pytest.mark.parametrize("late", [1, 30, 59])
def test_a_stamp_far_ahead_repeats_no_picture(tmp_path, caplog, late):
    """A picture would be shown for ten hours, or the clip, of which nothing is lost, be called unfinished."""
    times = [33 * one + 37_600_000 * (one >= late) for one in range(60)]
    clip = write_numbered(tmp_path / "a.mkv", 60, times_ms=times, bf="0")
    assert len(play(clip)[1]) in range(58, 62)
    assert "unfinished" not in caplog.text


@pytest.mark.parametrize("name", ["a.mkv", "a.mp4", "a.ts"])
def test_a_pause_is_a_pause_but_where_containers_jump(tmp_path, caplog, name):
    """A recorder that waits for motion leaves some; poses and times of all that follows would be 19 s off."""
    times = [33 * one + 19_000 * (one >= 30) for one in range(60)]
    _, pictures = play(write_numbered(tmp_path / name, 60, times_ms=times, bf="0"), fps=2.0)
    is_ts = name.endswith(".ts")
    assert len(pictures) in (range(3, 6) if is_ts else range(41, 44))
    assert ("jump by +19.0" if is_ts else "stands for 19.0 s at 1.0 s") in caplog.text


@pytest.mark.parametrize("group", [10, 60])
def test_what_an_edit_list_hides_is_not_missing(tmp_path, caplog, group):
    """A clip that was trimmed without being coded anew would be called unfinished."""
    whole = write_numbered(tmp_path / "whole.mp4", 60, bf="0", g=str(group))
    clip = copied([(whole, lambda packet: -15 * packet.duration)], tmp_path / "a.mp4")
    assert numbers(play(clip)[1]) == list(range(15, 60))
    assert "unfinished" not in caplog.text


def test_pictures_that_a_decoder_patched_are_counted(tmp_path, caplog):
    """A link that loses packets would show squares, and nobody be told where they come from."""
    clip = write_numbered(tmp_path / "a.ts", 60, bf="0", g="60", preset="ultrafast")
    data = bytearray(clip.read_bytes())
    for place in range(188 * 12 + 100, len(data), 188 * 20):
        data[place : place + 60] = bytes(60)
    clip.write_bytes(data)
    play(clip)
    assert "damaged pictures, shown as the decoder has patched them" in caplog.text


# -- which stream, which shape ----------------------------------------------


@pytest.mark.parametrize(
    ("name", "codec", "size", "count", "attached"),
    [
        ("a.mp4", "mjpeg", (640, 480), 1, False),
        ("a.mp4", "mjpeg", (640, 480), 1, True),
        ("a.ts", "libx264", (160, 120), 30, False),
    ],
    ids=["cover", "marked cover", "preview"],
)
def test_a_cover_picture_or_preview_is_no_film(tmp_path, name, codec, size, count, attached):
    """A grey or small picture would be flown in place of the film."""
    with av.open(str(tmp_path / name), "w") as container:
        cover, film = container.add_stream(codec, rate=30), container.add_stream("libx264", rate=30)
        cover.width, cover.height = size
        cover.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        film.width, film.height, film.pix_fmt = 320, 240, "yuv420p"
        if attached:
            cover.disposition = Disposition.attached_pic
        grey = np.full((*size[::-1], 3), 60, np.uint8)
        for stream, pictures in ((cover, [grey] * count), (film, map(numbered, range(30)))):
            for picture in pictures:
                frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
                container.mux(stream.encode(frame.reformat(format=stream.pix_fmt)))
            container.mux(stream.encode(None))
    source, pictures = play(tmp_path / name)
    assert numbers(pictures) == list(range(30))
    assert "is the film (h264, 320x240)" in source.notes[0]


def test_a_cover_picture_alone_is_called_so(tmp_path):
    """A song would fly as a film of one picture."""

    def setup(stream):
        stream.disposition = Disposition.attached_pic

    made = {"codec": "mjpeg", "pixels": "yuvj420p", "setup": setup, "pictures": [numbered(3)]}
    source, pictures = play(write_numbered(tmp_path / "a.mp4", **made))
    assert numbers(pictures[:1]) == [3]
    assert "it holds no film: what is shown is its cover picture" in source.notes


@pytest.mark.parametrize(
    ("aspect", "size"), [(Fraction(16, 11), (1024, 576)), (Fraction(10, 11), (704, 634)), (None, (704, 576))]
)
@pytest.mark.parametrize("name", ["a.mkv", "a.mp4"])
def test_pixels_are_made_square(tmp_path, aspect, size, name):
    """A round tank would be an ellipse, and every angle wrong."""

    def setup(stream):
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect

    squeezed = cv2.resize(numbered(1, size=size), (704, 576), interpolation=cv2.INTER_AREA)
    source, pictures = play(write_numbered(tmp_path / name, pictures=[squeezed] * 3, setup=setup))
    assert source.view.source_size == size
    wide, high = disc(pictures[0])
    assert wide == pytest.approx(high, abs=3)
    assert any("made square" in one for one in source.notes) is (aspect is not None)


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", [False, True])
def test_a_picture_is_turned_and_mirrored_as_it_says(tmp_path, degrees, mirror):
    """A mirrored phone or a camera that hangs upside down would show the world on its head."""

    def setup(stream):
        stream.set_display_rotation(degrees, hflip=mirror)

    clip = write_numbered(tmp_path / "a.mp4", pictures=[numbered(1)] * 3, setup=setup)
    _, (picture, *_) = play(clip)
    with av.open(str(clip)) as container:
        said = next(container.decode(video=0)).side_data.get("DISPLAYMATRIX")
    upright = [65536, 0, 0, 0, 65536]
    matrix = np.array(upright) if said is None else np.frombuffer(bytes(said), np.int32)
    # Where the matrix takes the middle of the red patch, from the middle of the picture.
    way = matrix[[0, 1, 3, 4]].reshape(2, 2).T / 65536 @ np.array([-120, -90])
    high, wide = picture.shape[:2]
    blue, green, red = picture[round(high / 2 + way[1]), round(wide / 2 + way[0])]
    assert red > 150
    assert max(int(blue), int(green)) < 60


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_jpeg_with_exif_data_is_shown_and_turned(tmp_path, orientation):
    """A camera of JPEGs with EXIF data, in a clip or over HTTP, ended the edge with a traceback."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    picture = np.zeros((96, 128, 3), np.uint8)
    picture[:48] = 255
    clip = tmp_path / "a.mjpeg"
    with clip.open("wb") as out:
        for _ in range(3):
            Image.fromarray(picture).save(out, "JPEG", exif=exif)
    _, pictures = play(clip)
    upright = picture if orientation == 1 else np.rot90(picture, -1)
    assert pictures[-1].shape == upright.shape
    assert np.abs(pictures[-1].astype(int) - upright).mean() < 5


def test_a_picture_that_nobody_needs_is_let_go_at_once(tmp_path):
    """Garbage that waits for Python's collector is a hundred megabytes of pictures."""
    clip = write_numbered(tmp_path / "a.mp4", 4, setup=lambda stream: stream.set_display_rotation(90))
    gc.collect()
    gc.disable()
    try:
        _, pictures = play(clip)
        frames = [one for one in gc.get_objects() if isinstance(one, av.VideoFrame)]
        waiting = [one for one in frames if one.format is not None]  # else it is empty, for a decoder to fill
    finally:
        gc.enable()
    assert len(pictures) == 4
    assert not waiting


def test_interlaced_film_has_no_combs(tmp_path):
    """What moves would have teeth, which a detector takes for anything."""

    def field(place):
        picture = np.full((576, 720, 3), 90, np.uint8)
        picture[200:380, 40 + 6 * place : 160 + 6 * place] = (0, 0, 191)
        return picture

    def woven(place):
        picture = field(2 * place)
        picture[1::2] = field(2 * place + 1)[1::2]
        return picture

    clip = tmp_path / "a.mp4"
    write_numbered(clip, pictures=[woven(one) for one in range(12)], rate=25, **{"x264-params": "tff=1"})
    source, pictures = play(clip, fps=25)
    assert len(pictures) == 12
    rows = pictures[6][210:370].astype(int)
    assert np.abs(rows[1::2] - rows[::2]).mean() < 1
    assert "interlaced" in " ".join(source.notes)


# -- range and colour ---------------------------------------------------------


def grey16(path, pictures, *, pixels="gray16le"):
    """A lossless film of sixteen bits, or of the upper ones."""
    return write_numbered(path, pictures=pictures, codec="ffv1", pixels=pixels)


def heat(*, body=30_500):
    """A wall of 29,300 to 29,500 levels, and a body."""
    rng = np.random.default_rng(3)
    levels = rng.integers(29_300, 29_500, (120, 160)).astype(np.uint16)
    levels[40:80, 60:80] = body
    return levels


def test_a_warm_body_shows_in_sixteen_bits_and_pulls_the_picture_slowly(tmp_path):
    """It would be five levels of 255 brighter than the wall, or the wall turn black at once when it comes in."""
    source, pictures = play(grey16(tmp_path / "a.mkv", [heat()] * 3))
    grey = pictures[0][..., 0].astype(int)
    assert grey[60, 70] - np.median(grey) > 150
    assert "stretched" in " ".join(source.notes)
    _, pictures = play(grey16(tmp_path / "b.mkv", [heat(body=29_400)] * 5 + [heat()] * 150))
    wall = [float(one[:30].mean()) for one in pictures]
    steps = np.abs(np.diff(wall))
    assert steps.max() < 15, "from one picture to the next"
    assert wall[4] - wall[-1] > 40, "in five seconds"


def test_a_sensor_of_twelve_bits_has_levels_of_its_own(tmp_path):
    """The noise of a plain wall was stretched from black to white: a level counted as sixteen."""
    wall = np.random.default_rng(3).integers(1800, 1806, (120, 160)).astype(np.uint16) << 4
    source, pictures = play(grey16(tmp_path / "a.mkv", [wall] * 3, pixels="gray12le"))
    assert np.ptp(pictures[0]) < 30
    assert "levels 1769.5 to 1833.5" in " ".join(source.notes)


@pytest.mark.parametrize("unseen", [np.nan, np.inf, -np.inf, np.uint16, np.int32])
def test_pictures_of_heat_in_a_folder_are_stretched_too(tmp_path, unseen):
    """Thermal converters write 32 bits (opencv#7025): they were unreadable, or all black; one alone was still."""
    levels = heat().astype(np.float32) / 100 - 273.15
    if isinstance(unseen, float):
        levels[:9] = unseen
        cv2.imwrite(str(tmp_path / "0.tiff"), levels)
    else:
        levels = heat().astype(unseen)
        levels[0, :6] = 0x102, 3, 2, 0, 16, 16  # in 16 bits, the bytes of the tag of grey with transparency
        Image.fromarray(levels).save(tmp_path / "0.tiff")
    for place in (tmp_path, tmp_path / "0.tiff"):
        source, pictures = play(place)
        assert pictures[0][60, 70, 0] - np.median(pictures[0]) > 150
        assert "stretched" in " ".join(source.notes)


@pytest.mark.parametrize(("kind", "pixels"), [("png", "ya16be"), ("tiff", "ya16le")])
def test_grey_with_transparency_is_stretched_in_a_folder_too(tmp_path, kind, pixels):
    """The file alone was stretched, and in a folder, or of a TIFF, it was nearly the same grey all over."""
    frame = av.VideoFrame(64, 48, pixels)
    grey = np.where(np.arange(48)[:, None] < 24, 7000, 7200).repeat(64, axis=1)
    frame.planes[0].update(
        np.dstack([grey, np.full_like(grey, 65_535)]).astype(">u2" if "be" in pixels else "<u2").tobytes()
    )
    coder = av.CodecContext.create(kind, "w")
    coder.width, coder.height, coder.pix_fmt, coder.time_base = 64, 48, pixels, Fraction(1, 25)
    (tmp_path / f"0.{kind}").write_bytes(b"".join(map(bytes, [*coder.encode(frame), *coder.encode(None)])))
    for place in (tmp_path / f"0.{kind}", tmp_path):
        source, pictures = play(place)
        assert pictures[0][(10, 40), 30, 0].tolist() == [0, 255]
        assert "stretched" in " ".join(source.notes)


def test_grey_of_eight_bits_that_holds_the_bytes_of_that_tag_stays_as_it_is(tmp_path):
    """It was stretched from black to white."""
    grey = np.random.default_rng(3).integers(60, 121, (48, 64)).astype(np.uint8)
    grey[0, :12] = (2, 1, 3, 0, 2, 0, 0, 0, 16, 0, 16, 0)
    Image.fromarray(grey).save(tmp_path / "0.tif")
    assert np.array_equal(play(tmp_path)[1][0][..., 0], grey)


def test_a_tiled_tiff_of_grey_with_transparency_is_not_flat(tmp_path):
    """FFmpeg decodes the tiles of a GeoTIFF to one grey without an error."""
    grey = np.where(np.arange(64)[:, None] < 24, 7000, 14_000).repeat(64, axis=1)
    pixels = np.dstack([grey, np.full_like(grey, 65_535)]).astype("<u2").tobytes()
    tags = {256: 64, 257: 64, 258: 16 | 16 << 16, 259: 1, 262: 1, 277: 2, 284: 1, 322: 64, 323: 64}
    counts, begin = {258: 2, 338: 1}, 8 + 2 + 12 * 12 + 4
    entries = [(tag, 3, counts.get(tag, 1), value) for tag, value in {**tags, 338: 2}.items()]
    entries = sorted([*entries, (324, 4, 1, begin), (325, 4, 1, len(pixels))])
    head = b"II*\0" + struct.pack("<IH", 8, len(entries))
    (tmp_path / "0.tif").write_bytes(
        head + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4) + pixels
    )
    source, pictures = play(tmp_path)
    assert pictures[0][(10, 40), 30, 0].tolist() == [0, 255]
    assert "stretched" in " ".join(source.notes)


@pytest.mark.parametrize("most", [(1000, 1023, 40_000, 900), (16_384, 900, 65_535), (0, 900, 40_000)])
def test_dark_colours_of_sixteen_bits_stay_dark_and_are_said(tmp_path, most):
    """Night was as bright as day, and jumped as the light grew; a camera's twelve bits were dark without a word."""
    for number, one in enumerate(most):
        cv2.imwrite(str(tmp_path / f"{number}.tiff"), np.full((60, 80, 3), (0, one // 2, one), np.uint16))
    cv2.imwrite(str(tmp_path / "0.png"), np.full((60, 80, 3), (0, most[0] // 2, most[0]), np.uint16))
    for place, shown in ((tmp_path / "0.tiff", most[:1]), (tmp_path / "0.png", most[:1]), (tmp_path, most)):
        source, pictures = play(place)
        for picture, one in zip(pictures, shown, strict=False):
            assert picture[30, 40].tolist() == pytest.approx([0, one / 514, one / 257], abs=1)
        assert (f"go up to {most[0]} of 65535" in " ".join(source.notes)) == (most[0] == 1000)


def test_dark_levels_of_a_bayer_sensor_are_said(tmp_path):
    """An industrial camera's twelve bits were nearly black without a word."""
    with av.open(str(tmp_path / "a.nut"), "w") as container:
        stream = container.add_stream("rawvideo", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "bayer_rggb16le"
        packet = av.Packet(np.full((64, 64), 2000, "<u2").tobytes())
        packet.stream, packet.pts, packet.dts, packet.time_base = stream, 0, 0, Fraction(1, 30)
        container.mux(packet)
    assert "16-bit colours go up to 2000 of 65535" in " ".join(play(tmp_path / "a.nut")[0].notes)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        # Whatever follows comes too early, and poses do not fit any more.
        ("f0001 f0002 f0003 f0004 f0008 f0009", "3 numbers are missing, the first after f0004.png"),
        ("9.05 9.1 9.5 9.55 10.0 10.05", ""),  # a script that writes str(time) shortens it
    ],
)
def test_pictures_come_in_the_order_of_their_numbers_or_times(tmp_path, names, says):
    """Of 9.05 and 9.5 the second came first, or the pictures that are missing were not said."""
    for number, name in enumerate(names.split()):
        cv2.imwrite(str(tmp_path / f"{name}.png"), numbered(number))
    source, pictures = play(tmp_path)
    assert numbers(pictures) == list(range(6))
    assert says in " ".join(source.notes)


@pytest.mark.parametrize("pixels", ["yuv420p10le", "gbrp10le"])
@pytest.mark.parametrize("transfer", ["smpte2084", pytest.param("arib-std-b67", marks=pytest.mark.nightly)])
def test_hdr_is_as_bright_as_its_white(tmp_path, transfer, pixels):
    """Everything would be grey, as a recorded screen was, which is RGB."""
    white = {"smpte2084": 0.581, "arib-std-b67": 0.75}[transfer]  # 203 nits, ITU-R BT.2408, table 1
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx265", rate=30)
        stream.width, stream.height, stream.pix_fmt = 128, 128, pixels
        matrix = "bt2020nc" if "yuv" in pixels else "gbr"
        bright = round(1023 * white) if matrix == "gbr" else round(64 + 876 * white)  # RGB is of full range
        tags = f"colorprim=bt2020:colormatrix={matrix}:transfer={transfer}"
        stream.options = {"x265-params": f"log-level=none:{tags}"}
        for _ in range(3):
            frame = av.VideoFrame(128, 128, pixels)
            for place, plane in enumerate(frame.planes):
                level = 512 if place and matrix != "gbr" else bright
                plane.update(np.full(plane.buffer_size // 2, level, np.uint16).tobytes())
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    source, (picture, *_) = play(tmp_path / "a.mp4")
    assert picture.mean() > 235
    assert "tone-mapped" in " ".join(source.notes)


@pytest.mark.parametrize(("size", "standard"), [((640, 480), "BT.601"), ((1280, 720), "BT.709")])
def test_untagged_colour_goes_by_height(tmp_path, size, standard):
    """The same car would be of another red in every second clip."""
    green = np.full((size[1], size[0], 3), (0, 191, 0), np.uint8)
    frame = av.VideoFrame.from_ndarray(green, format="bgr24")
    coded = frame.reformat(format="yuv420p", dst_colorspace=1 if standard == "BT.709" else 5)
    coded.colorspace = 2
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        container.mux(stream.encode(coded))
        container.mux(stream.encode(None))
    source, pictures = play(tmp_path / "a.mkv")
    assert patch(pictures[0], right=False) == pytest.approx((0, 191, 0), abs=6)
    assert f"no colour matrix: {standard}, because it has {size[1]} lines" in " ".join(source.notes)


@pytest.mark.parametrize("mode", ["P", "LA", "1"])
def test_no_matrix_is_missed_where_none_can_be(tmp_path, mode):
    """Who is told of a guess at the colours of a palette looks for a fault that there is not."""
    Image.new(mode, (160, 120)).save(tmp_path / "a.png")
    assert "matrix" not in " ".join(play(tmp_path / "a.png")[0].notes)


# -- damage -------------------------------------------------------------------


def jpegs(count, *, damaged=lambda number, data: None):
    made = [bytearray(cv2.imencode(".jpg", numbered(number))[1].tobytes()) for number in range(count)]
    for number, data in enumerate(made):
        damaged(number, data)
    return made


def break_head(data):
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = b"\xff\xdc\xff\xdc"


def cut(data):
    del data[len(data) // 2 :]


def lose_bytes(data):
    del data[len(data) // 2 : len(data) // 2 + 188]


@pytest.mark.parametrize("damage", [break_head, cut, lose_bytes])
def test_a_picture_that_is_damaged_is_held_over(tmp_path, caplog, damage):
    """One would end the flight in a traceback, or be half grey, half of an older one, or garbage."""
    film = jpegs(5, damaged=lambda number, data: damage(data) if number == 2 else None)
    for number, data in enumerate(film):
        (tmp_path / f"{number}.jpg").write_bytes(data)
    del film[3][-2:]  # as of some cameras, and whole
    (tmp_path / "a.mjpeg").write_bytes(b"".join(film))
    # OpenCV does not tell of bytes that are missing within.
    for place, says in (("", "2.jpg cannot be read"), ("a.mjpeg", "has 1 packets, damaged"))[
        damage is lose_bytes :
    ]:
        assert numbers(play(tmp_path / place, fps=25)[1]) == [0, 1, 1, 3, 4]
        assert says in caplog.text


@pytest.mark.parametrize("count", [5, 20])
@pytest.mark.parametrize("name", ["a.mjpeg", "a.avi"])
def test_where_no_picture_is_whole_they_are_shown_and_said_to_be_damaged(tmp_path, caplog, name, count):
    """A camera whose every picture breaks the standard would be dark, and a film of a few refused."""
    raw = tmp_path / "a.mjpeg"
    raw.write_bytes(b"".join(jpegs(count, damaged=lambda _, data: lose_bytes(data))))
    clip = raw if raw.name == name else copied([(raw, lambda _: 0)], tmp_path / name)
    _, pictures = play(clip, fps=25)
    assert len(pictures) == count
    assert f"has {count} damaged pictures, shown as the decoder has patched them" in caplog.text


@pytest.mark.parametrize("name", ["2026-01-26T20:57:04Z.mp4", "rtsp: a & b.mp4", "100%.mp4", "clip@2x.mp4"])
def test_what_is_there_is_a_file_whatever_its_name(tmp_path, monkeypatch, name):
    """A recorder's own names would be taken for addresses."""
    shutil.move(write_numbered(tmp_path / "a.mp4", 5), tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert numbers(play(name)[1]) == list(range(5))


def test_an_mp4_without_its_index_says_what_it_is(tmp_path):
    """Whose drone fell would hear that the file is no video."""
    clip = write_numbered(tmp_path / "cut.mp4", 30)
    clip.write_bytes(clip.read_bytes().partition(b"moov")[0][:-4])
    with pytest.raises(UserError, match=r"cut\.mp4' is unfinished: .*index \(moov\)"):
        play(clip)


FRAGMENTED = {"muxer": {"movflags": "frag_keyframe+empty_moov"}}


@pytest.mark.parametrize(
    ("name", "made", "zeros"),
    [
        ("a.mp4", {"muxer": {"movflags": "faststart"}}, 0),
        *(("a.mp4", FRAGMENTED, zeros) for zeros in (0, 8, 10, 4096)),
        *((name, {}, 0) for name in ("a.mkv", "a.ts")),
        # Two seconds are a third of it, but nothing beside ten hours.
        ("a.mkv", {"times_ms": [33 * one + 37_600_000 * (one >= 30) for one in range(150)]}, 0),
    ],
)
def test_a_cut_clip_says_that_it_is_unfinished(tmp_path, caplog, name, made, zeros):
    """Half of a clip would pass for a whole one, or a whole one, with reserved space behind it, for half of one."""
    clip = write_numbered(tmp_path / name, 150, **made, g="10", bf="0")
    data = clip.read_bytes()
    clip.write_bytes(data + bytes(zeros))
    play(clip)
    assert "unfinished" not in caplog.text
    clip.write_bytes(data[: len(data) * 6 // 10 | 1])
    assert 30 < len(play(clip)[1]) < 150
    assert f"{name} is unfinished: " in caplog.text


def test_a_file_that_grows_is_followed(tmp_path, monkeypatch):
    """Who flies what is still recorded would get its first second; or sit before its end for a minute."""
    whole = write_numbered(tmp_path / "whole.ts", 90, g="10", bf="0").read_bytes()
    growing = tmp_path / "growing.ts"
    half = len(whole) // 2 // 188 * 188
    growing.write_bytes(whole[:half])
    slept, turned = [], threading.Event()
    turned.set()

    def sleep(seconds):
        assert turned.wait(PATIENT_S), "the loop stands still: no status, no still, LINK LOST at the ground"
        slept.append(seconds)
        if len(slept) == 5:
            with growing.open("ab") as file:
                file.write(whole[half:])

    monkeypatch.setattr(container, "time", SimpleNamespace(sleep=sleep, monotonic=lambda: sum(slept)))
    played = []
    with open_source(str(growing), size=lambda size: size, fps=30, growing=True) as source:
        turned.clear()
        for frame in source.steps(start_ns=0):
            if frame is None:
                turned.set()
            else:
                played.append(number_of(frame.source_bgr))
    assert played == list(range(90))
    assert sum(slept) < 2.5 * container.QUIET_S, "once where stamps are looked at, once at the end"


def test_a_clip_that_has_grown_or_gone_since_it_was_opened_is_said(tmp_path, caplog):
    """It would end early, and nobody know why; whose stick was pulled would read a traceback."""
    clip = write_numbered(tmp_path / "a.ts", 60, bf="0")
    with open_source(str(clip), size=lambda size: size, fps=30) as source:
        frames = source.frames(start_ns=0)
        next(frames)
        with clip.open("ab") as file:
            file.write(bytes(188))
        list(frames)
        clip.unlink()
        with pytest.raises(UserError, match=r"can be read \(No such file or directory\)"):
            next(source.frames(start_ns=0))
    assert "it has grown by 188 bytes since: --follow waits for more" in caplog.text


@pytest.mark.parametrize(("level", "says"), [(0, "is black"), (120, "has not changed")])
def test_black_and_frozen_pictures_are_told_of_once(tmp_path, caplog, level, says):
    """A camera that shows nothing would pass for an empty scene."""
    same = np.full((64, 96, 3), level, np.uint8)
    pictures = [same] * 24 + [numbered(3, size=(96, 64))] * 2
    with caplog.at_level(logging.WARNING):
        play(write_numbered(tmp_path / "a.mkv", pictures=pictures, rate=2), fps=2)
    assert caplog.text.count(f"its picture {says} for 10 s") == 1
    assert "alive again" in caplog.text
