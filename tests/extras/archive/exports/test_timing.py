"""The table of ``--timing``: what a user reads the latency of each message from."""

import csv
import errno
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hvt_archive.exports.extra import TableOptions, TablesExtra
from hvt_archive.exports.tables import TIMING_COLUMNS, LineFile, SessionTiming, timing_table
from hvt_common.errors import UserError
from hvt_ground.events import MessageTiming, StillsRead


def message(kind: str = "base", *, sequence: int, handled_ns: int | None = 3_000) -> MessageTiming:
    return MessageTiming(kind, sequence, 5, 1_000, 1_500, 2_000, handled_ns, 5_100, -7)


def session(table: LineFile) -> SessionTiming:
    return SessionTiming(table, edge="uav-1", session_id=0xA1)


def lines(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_line_says_all_of_a_message(tmp_path):
    """A latency would be computed from the wrong times, or from two clocks as if they were one."""
    table = timing_table(tmp_path / "t.csv")
    one = session(table)
    one.log(message(sequence=4))
    one.log(message(sequence=5, handled_ns=0))
    first, second = lines(tmp_path / "t.csv")
    numbers = ("4", "5", "1000", "1500", "2000", "3000", "5100", "-7")
    assert tuple(first.values()) == ("base", *numbers, "uav-1", "000000a1")
    assert tuple(first) == TIMING_COLUMNS
    assert second["shown_ns"] == "0"


def test_a_still_has_its_line_when_it_was_read_or_never_will_be(tmp_path):
    """What came and was never looked at would count as seen, or not at all."""
    one = session(timing_table(tmp_path / "t.csv"))

    def shown() -> list[tuple[str, str]]:
        return [(row["sequence"], row["shown_ns"]) for row in lines(tmp_path / "t.csv")]

    for sequence in range(3):
        one.log(message("roi", sequence=sequence, handled_ns=None))
    assert shown() == []
    one.log(StillsRead((1,), 3_000))
    assert shown() == [("1", "3000")]
    one.close()
    one.log(StillsRead((2,), 3_000))  # perception that did not come back in time
    assert shown() == [("1", "3000"), ("0", "0"), ("2", "0")]


def test_stills_that_are_never_read_do_not_gather(tmp_path):
    """An edge that sends what nobody can read would fill the ground's memory."""
    one = session(timing_table(tmp_path / "t.csv"))
    for sequence in range(2000):
        one.log(message("roi", sequence=sequence, handled_ns=None))
    assert len(lines(tmp_path / "t.csv")) > 1000
    one.close()
    assert len(lines(tmp_path / "t.csv")) == 2000


@pytest.mark.parametrize(
    ("name", "said"), [("", r"table .*cannot be created"), ("/dev/full", "No space left")]
)
def test_a_file_that_cannot_be_is_one_sentence(tmp_path, name, said):
    """A flight would begin without its table; as root a ground would take away what other programs need."""
    with pytest.raises(UserError, match=said):
        timing_table(tmp_path / name)
    assert Path("/dev/full").is_char_device()


def test_a_folder_that_goes_is_noticed(tmp_path):
    """A stick that was pulled out: all would be written to a file that is in no folder."""
    (tmp_path / "stick").mkdir()
    table = timing_table(tmp_path / "stick" / "t.csv")
    shutil.rmtree(tmp_path / "stick")
    with pytest.raises(UserError, match="cannot be written any further: it was removed"):
        table.log("base,1\n")
    table.close()


def test_one_that_cannot_be_opened_again_leaves_no_files(tmp_path, monkeypatch):
    """Without a descriptor to spare each retry left an empty one."""
    opens: list[Callable[[], LineFile]] = []
    outputs = SimpleNamespace(open=lambda _part, opening: opens.append(opening))
    TablesExtra().start(TableOptions(timing=tmp_path / "t.csv"), outputs)  # type: ignore[arg-type]
    (open_table,) = opens
    open_table().close()
    with monkeypatch.context() as patch:
        patch.setattr(
            "hvt_archive.exports.tables.timing_table",
            Mock(side_effect=OSError(errno.EMFILE, "Too many open files")),
        )
        for _ in range(3):
            with pytest.raises(OSError, match="Too many open files"):
                open_table()
    assert [one.name for one in tmp_path.iterdir()] == ["t.csv"]
    open_table().close()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["t-2.csv", "t.csv"]
