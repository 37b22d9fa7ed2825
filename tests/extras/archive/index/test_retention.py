"""What is due to go, and what never is."""

import time
from dataclasses import replace

import pytest

from hvt_archive.index.retention import Due, Retention, due
from hvt_common.units import SECOND_NS, Limit
from hvt_ground.recordings.row import RecordingRow

DAY_NS = 86_400 * SECOND_NS
NOW_NS = 1_790_000_000 * SECOND_NS


def name(days: float) -> str:
    """Of a file whose session began so many days ago."""
    begun = time.localtime((NOW_NS - round(days * DAY_NS)) // SECOND_NS)
    return f"hvt-uav-1-{time.strftime('%Y%m%d-%H%M%S', begun)}.rrd"


def row(days: float, *, video: bool = True, file: str | None = None) -> RecordingRow:
    """A file of 100 MB that was written to last so many days ago, and named then."""
    written_ns = NOW_NS - round(days * DAY_NS)
    file = file or name(days)
    return RecordingRow(file, "uav-1", "00ff", None, None, written_ns, 100_000_000, 1, 0, video=video)


def names(*days: float) -> tuple[str, ...]:
    return tuple(map(name, days))


def _nobody(_name: str) -> bool:
    return False


ROWS = [row(days) for days in (0, 1, 5, 20)]


@pytest.mark.parametrize(
    ("keep", "remove", "outdated"),
    [
        ((), (), ()),
        ((Limit(seconds=14 * 86_400),), (), (20,)),
        ((Limit(size_bytes=400_000_000),), (), ()),
        ((Limit(size_bytes=399_999_999),), (20,), ()),
        ((Limit(size_bytes=150_000_000),), (20, 5, 1), ()),
        ((Limit(seconds=3 * 86_400), Limit(size_bytes=300_000_000)), (20,), (20, 5)),
        ((Limit(size_bytes=100_000_000), Limit(seconds=14 * 86_400)), (20, 5, 1), (20,)),
        ((Limit(size_bytes=1),), (20, 5, 1, 0), ()),
    ],
)
def test_the_oldest_go_first(keep, remove, outdated):
    """The disk would fill, or the flight of today be gone."""
    found = due(ROWS, Retention(keep), in_use=_nobody, now_ns=NOW_NS)
    assert found == Due(names(*remove), names(*outdated))


def test_an_edge_that_sends_much_evicts_nobody_else():
    """One with valid keys would have all flights of the others removed, within an hour."""
    rows = [replace(row(20 - number / 10), edge="uav-2") for number in range(2)]
    rows += [replace(row(10 - number / 100), edge="evil") for number in range(50)]
    wanted = Retention((Limit(size_bytes=1_000_000_000),))
    removed = due(rows, wanted, in_use=_nobody, now_ns=NOW_NS).remove
    assert removed == tuple(one.file for one in rows[2:44]), "its own oldest"
    in_use = [one.file for one in rows[2:]]
    assert due(rows, wanted, in_use=in_use.__contains__, now_ns=NOW_NS).remove == tuple(
        one.file for one in rows[:2]
    )


def test_what_is_written_stays_and_counts():
    """The flight in the air would be lost, or the disk hold more than was allowed."""
    limits = (Limit(size_bytes=150_000_000), Limit(seconds=1.0))
    found = due(ROWS, Retention(limits), in_use=names(20, 0).__contains__, now_ns=NOW_NS)
    assert (found.remove, found.outdated) == (names(5, 1), names(5, 1))


def test_video_goes_before_the_rest():
    """Who wants to know in a year what flew there would have to keep all pictures for it."""
    rows = [*ROWS, row(7, video=False)]
    wanted = Retention((Limit(seconds=14 * 86_400),), Limit(seconds=3 * 86_400))
    assert due(rows, wanted, in_use=_nobody, now_ns=NOW_NS) == Due((), names(20), names(5))


@pytest.mark.parametrize(
    "file",
    [
        pytest.param(name(0), id="a name of today: the index was with another clock"),
        pytest.param("hvt-uav-1-19700101-000100.rrd", id="named before the machine knew the time"),
        pytest.param("hvt-uav-1-20269999-000100.rrd", id="named by no calendar"),
        pytest.param("flight-0001.rrd", id="named by somebody"),
    ],
)
def test_an_age_that_the_name_does_not_confirm_is_none(file):
    """A ground without a battery clock begins in 1970: its flights would be gone once it knows the time."""
    first = row(100, file=file)
    ages = Retention((Limit(seconds=86_400.0),), Limit(seconds=3600.0))
    assert due([first], ages, in_use=_nobody, now_ns=NOW_NS) == Due()
    assert due([first], Retention((Limit(size_bytes=1),)), in_use=_nobody, now_ns=NOW_NS).remove == (file,)


def test_an_age_that_the_index_does_not_confirm_is_none():
    """The flight of five minutes ago has a name of a hundred days ago: its ground was that long on the shelf."""
    fresh = row(0, file=name(100))
    ages = Retention((Limit(seconds=86_400.0),), Limit(seconds=3600.0))
    assert due([fresh], ages, in_use=_nobody, now_ns=NOW_NS) == Due()
