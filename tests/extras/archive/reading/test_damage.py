"""What is read of recordings that are damaged, and of those that only seem to be."""

import os

import pytest

from hvt_archive.joined import join_recordings
from hvt_archive.reading.recorded import read_recordings
from media.recorded_feed import coded, drawn_frames, session
from programs.rrd import damaged, recorded

FRAMES, SIZE = 8, (320, 192)


@pytest.fixture(scope="module")
def events():
    """Half a second."""
    drawn = drawn_frames(FRAMES, SIZE)
    return [one for one, _ in session(drawn, coded(drawn, kbps=300, keyint=8), tracks=2, total_kbps=500)]


def test_what_is_behind_a_hole_is_read(events, tmp_path):
    """A card that loses a block loses the length of a message too: the rest of the flight was left out."""
    path = recorded(tmp_path / "flight.rrd", events)
    path.write_bytes(damaged(path.read_bytes(), b"/link/bitrate", at=-20, by=bytes(40)))
    assert len(read_recordings([path]).video) == FRAMES


def test_what_is_no_damage_is_not_called_so(events, tmp_path, caplog):
    """Of two flights put together the second was left out as damage, and a name in another encoding was that, too."""
    odd, two = tmp_path / os.fsdecode(b"fl\xfcg.rrd"), recorded(tmp_path / "two.rrd", events)
    odd.write_bytes(two.read_bytes())
    other = recorded(tmp_path / "other.rrd", events, session="00fe").read_bytes()
    with two.open("ab") as file:
        file.write(other)
    assert [len(read_recordings([one]).video) for one in (odd, two)] == [FRAMES, FRAMES]
    join_recordings([two], tmp_path / "joined.rrd", base_size=SIZE, fps=15)
    said = f"{two} is several recordings in one file, another begins after {odd.stat().st_size} bytes: the first is"
    assert [one.getMessage() for one in caplog.records] == [f"{said} exported", f"{said} joined"]


def test_what_a_power_cut_left_twice_counts_once(events, tmp_path, monkeypatch):
    """Where the file was not cut yet behind compacted rows, the video was left out, and stills came twice."""
    stills = len(read_recordings([recorded(tmp_path / "whole.rrd", events)]).stills)
    monkeypatch.setattr(os, "ftruncate", lambda *_: None)
    read = read_recordings([recorded(tmp_path / "flight.rrd", events)])
    assert ([one.frame_index for one in read.video], len(read.stills)) == (list(range(FRAMES)), stills)
    assert stills
