"""``kill -9`` in the air, which `make kills` flies: its seeds, and that its judgement can be a bad one."""

import contextlib
import sqlite3

import pytest

from hvt_edge.backlog.disk import FILE_NAME, Store
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from lab.link.kills import BARS, Trial, Verdict, in_matroska, in_recording, missing_s, plan, rows_of
from lab.link.measures.store_left import StoreLeft, store_left
from lab.link.measures.timing import Arrival
from media.clips import framed, smooth_pictures
from rigs.flight import Flight

SIZE = (320, 192)


def test_the_kills_come_from_the_seed_and_hit_both_sides():
    """A failure could not be seen again; or one side would never be tried."""
    trials = plan(50, seed=3)
    assert trials == plan(50, seed=3)
    assert [one.after_s for one in trials] != [one.after_s for one in plan(50, seed=4)]
    assert sum(one.victim == "edge" for one in trials) == 25
    ending = [one.victim for one in trials if one.ending_s is not None]
    assert (ending.count("edge"), ending.count("ground")) == (5, 5)


def arrival(index: int) -> Arrival:
    at_s = 1_790_000_000 + index / 10
    return Arrival("base", index, index, at_s, at_s + 0.01, at_s + 0.05, True, 1000)


def test_what_is_missing_counts_from_the_first_hole():
    """A recording with a hole in its middle would pass for one that lacks its last frame."""
    frames = [arrival(index) for index in range(40)]
    times = [one.capture_s for one in frames]
    assert missing_s(frames, [at_s + 0.0004 for at_s in times]) == 0
    assert missing_s(frames, times[:-2]) == pytest.approx(0.2)
    assert missing_s(frames, [*times[:10], *times[11:]]) == pytest.approx(3.0)
    assert missing_s(frames, []) == pytest.approx(4.0)


def test_what_cannot_be_read_is_noticed(tmp_path, capsys):
    """The bar would hold whatever the files are."""
    for name in ("run.rrd", "base.mkv"):
        (tmp_path / name).write_bytes(b"\x1aE\xdf\xa3" + bytes(5000))
    for read, ending in ((in_recording, "rrd"), (in_matroska, "mkv")):
        assert read(tmp_path / f"{'run' if ending == 'rrd' else 'base'}.{ending}") is None
        assert read(tmp_path / f"absent.{ending}") is None
    assert "absent.mkv" in capsys.readouterr().err


def test_a_store_is_read_as_the_next_start_would(tmp_path):
    """What the edge kept through the outage would be lost at its crash, and the bar hold."""
    encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=10, bitrate_bps=200_000, preset="ultrafast"))
    frames = framed(smooth_pictures(30, size=SIZE), fps=10)
    units = [encoder.encode(frame, keyframe=frame.index % 10 == 0) for frame in frames]
    info = Flight(1).info().pack()
    with Store(tmp_path / "store", max_bytes=10**8, session_id=7, info=lambda: info) as store:
        for unit in units:
            store.add_unit(unit)
    assert store_left(tmp_path / "none") == StoreLeft(0, 0, 0.0), "a flight without one counts against nobody"
    whole = store_left(tmp_path / "store")
    assert (whole.objects, whole.unreadable, whole.missing_s) == (1, 0, 0)

    def damage(frame: int) -> StoreLeft:
        with contextlib.closing(sqlite3.connect(tmp_path / "store" / FILE_NAME)) as db, db:
            db.execute("UPDATE part SET crc = 0 WHERE frame_index = ?", (frame,))
        return store_left(tmp_path / "store")

    cut = damage(20)
    assert (cut.unreadable, cut.missing_s) == (0, pytest.approx(1.0))
    assert damage(0).unreadable == 1


def test_a_bad_end_holds_no_bar():
    """The table would say yes to everything."""
    trial = Trial(0, "edge", 1.0, None)
    kept, spoilt = StoreLeft(3, 0, 0.2), StoreLeft(3, 1, 0.5)
    good = Verdict(trial, 10, 0.0, 0.1, 0.2, ended=False, store=kept, survivor=0)
    bad = Verdict(trial, 10, None, 0.4, 0.2, ended=True, store=spoilt, survivor=None)
    rows = {row["measure"]: row for row in rows_of([good, bad])}
    assert rows["kills"]["value"] == 1
    for name in set(BARS) - {"kills", "missing from a recording at most, s", "Matroska files unreadable"}:
        assert rows[name]["holds"] is False, name
