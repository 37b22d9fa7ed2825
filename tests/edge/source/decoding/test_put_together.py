"""Clips that change in their midst: recordings put together, frames that a recorder dropped, a film turned."""

from __future__ import annotations

import os
import re
from fractions import Fraction

import av
import cv2
import pytest

from hvt_edge.source.opening import open_source
from media.numbered import disc, number_of, numbered, patch, write_numbered


def play(spec, **settings):
    """Its pictures, each as often as it is shown, at 30 frames a second."""
    with open_source(str(spec), size=lambda size: size, fps=30.0, **settings) as source:
        return [frame.source_bgr for frame in source.frames(start_ns=0)]


def write(path, numbers, *, setup=lambda _: None, codec="libx264", group=15, **muxer):
    """A clip of those numbered pictures, each at its own place of 30 a second."""
    with av.open(str(path), "w", options=muxer) as container:
        stream = container.add_stream(codec, rate=30, options={"bf": "0", "g": str(group)})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        setup(stream)
        for number in numbers:
            frame = av.VideoFrame.from_ndarray(numbered(number), format="bgr24").reformat(format="yuv420p")
            frame.pts, frame.time_base = number - numbers[0], Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def put_together(tmp_path, ending, *, settings=({}, {}), setups=(lambda _: None, lambda _: None)):
    """Frames 0 to 59 and 60 to 119, each half with its muxer's settings, in one file."""
    parts = []
    for turn in range(2):
        part = tmp_path / f"{turn}.{ending}"
        write(part, range(60 * turn, 60 * turn + 60), setup=setups[turn], **settings[turn])
        parts.append(part.read_bytes())
    both = tmp_path / f"both.{ending}"
    both.write_bytes(b"".join(parts))
    return both


def test_two_recordings_play_whole_where_time_begins_anew(tmp_path, caplog):
    """The first of two would be lost; of the second each third frame was, as Matroska has whole milliseconds."""
    for ending in ("ts", "mkv"):
        assert [number_of(one) for one in play(put_together(tmp_path, ending))] == list(range(120))
        assert f"both.{ending}: its time stamps jump by -1.967 s" in caplog.text


def test_a_film_that_goes_on_under_another_number_is_the_same(tmp_path):
    """A sender that begins anew may number its streams otherwise (mpv#4305): the rest was not shown."""
    clip = put_together(tmp_path, "ts", settings=({}, {"mpegts_start_pid": "512"}))
    assert {*range(59), *range(60, 120)} <= {number_of(one) for one in play(clip)}


@pytest.mark.parametrize("growing", [False, True])
def test_a_playlist_without_its_end_plays_from_its_beginning(tmp_path, growing):
    """Of a recording that broke off, whose list looks live, three parts were played; with --follow none."""
    playlist = tmp_path / "a.m3u8"
    write(playlist, range(30), group=3, hls_time="0.1", hls_list_size="0")
    playlist.write_text(playlist.read_text().replace("#EXT-X-ENDLIST", ""))
    assert [number_of(one) for one in play(playlist, growing=growing)] == list(range(30))


def test_a_playlist_whose_time_begins_anew_is_whole(tmp_path, caplog):
    """It was played to its end, and called unfinished."""
    put_together(tmp_path, "ts")
    parts = "#EXTINF:2,\n0.ts\n#EXT-X-DISCONTINUITY\n#EXTINF:2,\n1.ts\n"
    (tmp_path / "a.m3u8").write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:2\n{parts}#EXT-X-ENDLIST\n")
    assert [number_of(one) for one in play(tmp_path / "a.m3u8")] == list(range(120))
    assert "unfinished" not in caplog.text


@pytest.mark.parametrize(
    ("ending", "options"), [("ts", {"mpegts_pmt_start_pid": "4200"}), ("flv", {}), ("mp4", {})]
)
def test_a_recording_behind_the_film_is_said(tmp_path, caplog, ending, options):
    """FFmpeg ends with the first: half of a file was lost without a word, or the edge ended in a traceback."""
    clip = put_together(
        tmp_path, ending, settings=({}, {**options, "mpegts_start_pid": "512"} if options else {})
    )
    assert [number_of(one) for one in play(clip)] == list(range(60))
    assert "hold nothing of this film, but perhaps another recording" in caplog.text


def test_fragments_of_another_recording_are_said(tmp_path, caplog):
    """The first of them was lost, and those of another size were garbage, without a word."""
    fragmented = {"movflags": "frag_every_frame+empty_moov+default_base_moof"}
    play(put_together(tmp_path, "mp4", settings=(fragmented, fragmented)))
    assert "both.mp4 is unfinished: another recording is behind it" in caplog.text


@pytest.mark.parametrize(
    ("missing", "says"),
    [
        (slice(2), "its first fragment is number 3: is its beginning missing?"),
        (slice(1, 2), "its fragments are not in a row: number 3 follows 1"),
    ],
)
def test_a_fragment_that_is_missing_is_said(tmp_path, caplog, missing, says):
    """The picture stood still, or began late, without a word, where an upload had lost a part."""
    write(tmp_path / "a.mp4", range(60), movflags="frag_keyframe+empty_moov+default_base_moof")
    head, *fragments = (tmp_path / "a.mp4").read_bytes().split(b"moof")
    del fragments[missing]
    (tmp_path / "a.mp4").write_bytes(b"moof".join([head, *fragments]))
    play(tmp_path / "a.mp4")
    assert f"a.mp4 is unfinished: {says}" in caplog.text


@pytest.mark.parametrize(
    ("missing", "says"), [(0, "it is 2.0 s shorter than its header says"), (1, "stands for 2.0 s")]
)
def test_a_segment_that_is_missing_is_said(tmp_path, caplog, missing, says):
    """FFmpeg goes on with the next: the picture stood still, or the film began late, without a word."""
    write(tmp_path / "a.m3u8", range(180), group=60, hls_time="2", hls_list_size="0")
    (tmp_path / f"a{missing}.ts").unlink()
    play(tmp_path / "a.m3u8")
    assert says in caplog.text


def test_a_playlist_of_whole_seconds_is_whole(tmp_path, caplog):
    """Of segments of 1.6 s with sound each would be said to last 2: the film would be called unfinished."""
    write(tmp_path / "a.m3u8", range(192), group=48, hls_time="1.6", hls_list_size="0")
    text = (tmp_path / "a.m3u8").read_text()
    assert "#EXTINF:1.6" in text
    (tmp_path / "a.m3u8").write_text(re.sub(r"#EXTINF:1\.6\d*", "#EXTINF:2", text))
    assert [number_of(one) for one in play(tmp_path / "a.m3u8")] == list(range(192))
    assert "unfinished" not in caplog.text


def test_another_codec_in_the_midst_is_not_called_damage_alone(tmp_path, caplog):
    """Who looks for a fault of the disk or the link would look in vain."""
    write(tmp_path / "0.ts", range(30))
    write(tmp_path / "1.ts", range(30), codec="mpeg2video")
    (tmp_path / "a.ts").write_bytes(b"".join((tmp_path / f"{one}.ts").read_bytes() for one in range(2)))
    play(tmp_path / "a.ts")
    assert "packets, damaged or of another codec than h264, which were skipped" in caplog.text


def test_packets_that_a_recorder_lost_are_said(tmp_path, caplog):
    """H.264 over a gap is smeared up to its next keyframe, and no picture of it is marked as damaged."""
    write(tmp_path / "a.ts", range(30), group=30)
    data = (tmp_path / "a.ts").read_bytes()
    (tmp_path / "a.ts").write_bytes(data[: 188 * 30] + data[188 * 35 :])
    play(tmp_path / "a.ts")
    assert "a.ts lacks packets at 1 pictures" in caplog.text


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

    pictures = play(put_together(tmp_path, "ts", setups=(wide, lambda _: None)))
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
    write(tmp_path / "a.avi", taken, codec=codec, group=1)
    shown = [number_of(one) for one in play(tmp_path / "a.avi")]
    assert shown == [max(one for one in taken if one <= place) for place in range(30)]
    assert "unfinished" not in caplog.text
