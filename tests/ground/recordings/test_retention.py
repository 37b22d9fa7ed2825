"""What is due to go, and what never is."""

from __future__ import annotations

import pytest

from hvt_common.units import SECOND_NS, Limit
from hvt_ground.recordings.retention import Due, Retention, due
from hvt_ground.recordings.row import RecordingRow

DAY_NS = 86_400 * SECOND_NS
NOW_NS = 1_790_000_000 * SECOND_NS


def row(days: float, *, video: bool = True, written_ns: int | None = None) -> RecordingRow:
    """A file of 100 MB that was written to last so many days ago."""
    written_ns = NOW_NS - round(days * DAY_NS) if written_ns is None else written_ns
    return RecordingRow(
        f"{days:g}.rrd", "uav-1", "00ff", None, None, written_ns, 100_000_000, 1, 0, video=video
    )


ROWS = [row(days) for days in (0, 1, 5, 20)]


@pytest.mark.parametrize(
    ("keep", "remove"),
    [
        ((), ()),
        ((Limit(seconds=14 * 86_400),), ("20.rrd",)),
        ((Limit(size_bytes=400_000_000),), ()),
        ((Limit(size_bytes=399_999_999),), ("20.rrd",)),
        ((Limit(size_bytes=150_000_000),), ("20.rrd", "5.rrd", "1.rrd")),
        ((Limit(seconds=3 * 86_400), Limit(size_bytes=200_000_000)), ("20.rrd", "5.rrd")),
        ((Limit(size_bytes=100_000_000), Limit(seconds=14 * 86_400)), ("20.rrd", "5.rrd", "1.rrd")),
        ((Limit(size_bytes=1),), ("20.rrd", "5.rrd", "1.rrd", "0.rrd")),
    ],
)
def test_the_oldest_go_first(keep, remove):
    """The disk would fill, or the flight of today be gone."""
    assert due(ROWS, Retention(keep), in_use=(), now_ns=NOW_NS) == Due(remove)


def test_what_is_written_stays_and_counts():
    """The flight in the air would be lost, or the disk hold more than was allowed."""
    limits = (Limit(size_bytes=150_000_000), Limit(seconds=1.0))
    assert due(ROWS, Retention(limits), in_use={"20.rrd", "0.rrd"}, now_ns=NOW_NS).remove == (
        "5.rrd",
        "1.rrd",
    )


def test_video_goes_before_the_rest():
    """Who wants to know in a year what flew there would have to keep all pictures for it."""
    rows = [*ROWS, row(7, video=False)]
    wanted = Retention((Limit(seconds=14 * 86_400),), Limit(seconds=3 * 86_400))
    assert due(rows, wanted, in_use=(), now_ns=NOW_NS) == Due(("20.rrd",), ("5.rrd",))


def test_a_file_of_unknown_age_is_not_old():
    """A ground without a battery clock begins in 1970: its flights would be gone once it knows the time."""
    first = row(0, written_ns=60 * SECOND_NS)
    assert (
        due([first], Retention((Limit(seconds=1.0),), Limit(seconds=1.0)), in_use=(), now_ns=NOW_NS) == Due()
    )
    assert due([first], Retention((Limit(size_bytes=1),)), in_use=(), now_ns=NOW_NS).remove == ("0.rrd",)
