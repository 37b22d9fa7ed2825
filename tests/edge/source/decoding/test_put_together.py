"""Clips that change in their midst: recordings put together, frames that a recorder dropped, a film turned."""

import os
import re
from fractions import Fraction

import cv2
import pytest

from hvt_edge.source.opening import open_source
from media.numbered import disc, number_of, numbered, patch, write_numbered


def play(spec, **settings):
    """Its pictures, each as often as it is shown, at 30 frames a second."""
    with open_source(str(spec), size=lambda size: size, fps=30.0, **settings) as source:
        return [frame.source_bgr for frame in source.frames(start_ns=0)]


def numbers(spec, **settings):
    return [number_of(one) for one in play(spec, **settings)]


def write(path, numbers, *, setup=lambda _: None, codec="libx264", group=15, **muxer):
    """A clip of those numbered pictures, each at its own place of 30 a second."""
    places, pictures = [one - numbers[0] for one in numbers], map(numbered, numbers)
    made = {"setup": setup, "codec": codec, "places": places, "pictures": pictures, "muxer": muxer}
    return write_numbered(path, **made, bf="0", g=str(group))


def put_together(tmp_path, ending, *, settings=({}, {}), setup=lambda _: None, codecs=("libx264",) * 2):
    """Frames 0 to 59, with ``setup``, and 60 to 119, each half with its muxer's settings, in one file."""
    both = tmp_path / f"both.{ending}"
    with both.open("wb") as out:
        for turn, prepare in enumerate((setup, lambda _: None)):
            half = range(60 * turn, 60 * turn + 60)
            made = {"setup": prepare, "codec": codecs[turn], **settings[turn]}
            out.write(write(tmp_path / f"{turn}.{ending}", half, **made).read_bytes())
    return both


@pytest.mark.parametrize("ending", ["ts", "mkv"])
def test_two_recordings_play_whole_where_time_begins_anew(tmp_path, caplog, ending):
    """The first of two would be lost; of the second each third frame was, as Matroska has whole milliseconds."""
    assert numbers(put_together(tmp_path, ending)) == list(range(120))
    assert f"both.{ending}: its time stamps jump by -1.967 s" in caplog.text


def test_a_film_that_goes_on_under_another_number_is_the_same(tmp_path):
    """A sender that begins anew may number its streams otherwise (mpv#4305): the rest was not shown."""
    clip = put_together(tmp_path, "ts", settings=({}, {"mpegts_start_pid": "512"}))
    assert {*range(59), *range(60, 120)} <= set(numbers(clip))


@pytest.mark.parametrize("growing", [False, True])
def test_a_playlist_without_its_end_plays_from_its_beginning(tmp_path, growing):
    """Of a recording that broke off, whose list looks live, three parts were played; with --follow none."""
    playlist = write(tmp_path / "a.m3u8", range(30), group=3, hls_time="0.1", hls_list_size="0")
    playlist.write_text(playlist.read_text().replace("#EXT-X-ENDLIST", ""))
    assert numbers(playlist, growing=growing) == list(range(30))


def test_a_playlist_whose_time_begins_anew_or_is_of_whole_seconds_is_whole(tmp_path, caplog):
    """It was played to its end, and called unfinished: of segments of 1.6 s each would be said to last 2."""
    put_together(tmp_path, "ts")
    parts = "#EXTINF:2,\n0.ts\n#EXT-X-DISCONTINUITY\n#EXTINF:2,\n1.ts\n"
    (tmp_path / "a.m3u8").write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:2\n{parts}#EXT-X-ENDLIST\n")
    assert numbers(tmp_path / "a.m3u8") == list(range(120))
    rounded = write(tmp_path / "b.m3u8", range(192), group=48, hls_time="1.6", hls_list_size="0")
    text = rounded.read_text()
    assert "#EXTINF:1.6" in text
    rounded.write_text(re.sub(r"#EXTINF:1\.6\d*", "#EXTINF:2", text))
    assert numbers(rounded) == list(range(192))
    assert "unfinished" not in caplog.text


FRAGMENTS = {"movflags": "frag_every_frame+empty_moov+default_base_moof"}
OTHER_PIDS = {"mpegts_pmt_start_pid": "4200", "mpegts_start_pid": "512"}


def without_fragments(tmp_path, missing):
    clip = write(tmp_path / "a.mp4", range(60), movflags="frag_keyframe+empty_moov+default_base_moof")
    head, *fragments = clip.read_bytes().split(b"moof")
    del fragments[missing]
    clip.write_bytes(b"moof".join([head, *fragments]))
    return clip


def with_hole(tmp_path):
    clip = without_fragments(tmp_path, slice(0))
    data = clip.read_bytes()
    third = [found.start() for found in re.finditer(b"moof", data)][2]
    clip.write_bytes(data[: third - 200] + bytes(400) + data[third + 200 :])
    return clip


def without_segment(tmp_path, number):
    playlist = write(tmp_path / "a.m3u8", range(180), group=60, hls_time="2", hls_list_size="0")
    (tmp_path / f"a{number}.ts").unlink()
    return playlist


def without_packets(tmp_path):
    data = write(tmp_path / "a.ts", range(30), group=30).read_bytes()
    (tmp_path / "a.ts").write_bytes(data[: 188 * 30] + data[188 * 35 :])
    return tmp_path / "a.ts"


@pytest.mark.parametrize(
    ("made", "says"),
    [
        # FFmpeg ends with the first: half of a file was lost without a word, or the edge ended in a traceback.
        *(
            (
                lambda at, one=one: put_together(at, *one[:1], settings=({}, one[1])),
                "hold nothing of this film, but",
            )
            for one in (("ts", OTHER_PIDS), ("flv", {}), ("mp4", {}))
        ),
        # The first of them was lost, and those of another size were garbage.
        (
            lambda at: put_together(at, "mp4", settings=(FRAGMENTS, FRAGMENTS)),
            "both.mp4 is unfinished: another recording is behind it",
        ),
        # The picture stood still, or began late, where an upload had lost a part.
        (
            lambda at: without_fragments(at, slice(2)),
            "a.mp4 is unfinished: its first fragment is number 3: is its",
        ),
        (
            lambda at: without_fragments(at, slice(1, 2)),
            "unfinished: its fragments are not in a row: number 3 follows",
        ),
        # Half of a recording was lost where some sectors of its disk were.
        (with_hole, "bytes hold no fragment that can be read"),
        (lambda at: without_segment(at, 0), "it is 2.0 s shorter than its header says"),
        (lambda at: without_segment(at, 1), "stands for 2.0 s"),
        # Who looks for a fault of the disk or the link would look in vain.
        (
            lambda at: put_together(at, "ts", codecs=("libx264", "mpeg2video")),
            "packets, damaged or of another codec than h264, which were skipped",
        ),
        # H.264 over a gap is smeared up to its next keyframe, and no picture of it is marked as damaged.
        (without_packets, "a.ts lacks packets at 1 pictures"),
    ],
)
def test_what_is_missing_is_said(tmp_path, caplog, made, says):
    """A part would be lost without a word."""
    shown = numbers(made(tmp_path))
    assert says in caplog.text
    assert "but perhaps" not in caplog.text or shown == list(range(60))


def test_of_a_file_of_many_pictures_it_is_said_that_one_is_shown(tmp_path):
    """A thermal recording of minutes, in one TIFF, was one picture, without a word."""
    cv2.imwritemulti(str(tmp_path / "0.tiff"), [numbered(0), numbered(1)])
    old = (tmp_path / "0.tiff").rename(tmp_path / os.fsdecode(b"caf\xe9.tiff"))  # a name of Latin-1
    with open_source(str(old), size=(320, 240), fps=1) as opened:
        assert ".tiff holds 2 pictures: of a file the first alone is shown" in " ".join(opened.notes)


def test_pixels_are_made_square_when_their_shape_changes_too(tmp_path):
    """Who puts 4:3 and 16:9 together would see all that follows too wide by a third."""

    def wide(stream):
        stream.codec_context.sample_aspect_ratio = Fraction(16, 11)

    pictures = play(put_together(tmp_path, "ts", setup=wide))
    for place, aspect in ((10, 16 / 11), (100, 1)):
        across, down = disc(pictures[place])
        assert across == pytest.approx(aspect * down, rel=0.03)


def test_a_turn_that_a_keyframe_says_holds_up_to_the_next(tmp_path):
    """One picture in each group would be turned, and the others not."""
    clip = write_numbered(tmp_path / "a.h264", 9, bf="0")
    nals = clip.read_bytes().split(b"\0\0\1")
    # SEI 47, display orientation: not cancelled, mirrored left to right, no turn, until the next (H.264, D.1.27).
    message = b"\x06\x2f\x03\x40\x00\x18\x80"
    first = next(place for place, one in enumerate(nals) if one[:1] and one[0] & 31 == 5)
    clip.write_bytes(b"\0\0\1".join([*nals[:first], message, *nals[first:]]))
    assert {patch(one, right=True)[2] > 150 for one in play(clip)} == {True}


@pytest.mark.parametrize("codec", ["mpeg4", "libx264"])
def test_a_frame_that_a_recorder_dropped_keeps_its_place(tmp_path, caplog, codec):
    """AVI has an empty one there: it was called unfinished, and of H.264 the frame before came too late."""
    taken = [one for one in range(30) if one not in {5, 6, 7}]
    shown = numbers(write(tmp_path / "a.avi", taken, codec=codec, group=1))
    assert shown == [max(one for one in taken if one <= place) for place in range(30)]
    assert "unfinished" not in caplog.text
