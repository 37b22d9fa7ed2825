"""How far a study is."""

import re
import subprocess
import sys
from collections import deque

import pytest

from hvt_common.errors import UserError
from hvt_study.commands import output
from hvt_study.commands.output import RunProgress, check_out, time_left_s, writing
from programs.processes import eventually


def test_who_waits_reads_a_line_while_all_is_still_opened(capsys):
    """Ten seconds of silence look like a program that hangs."""
    said = ""

    def read() -> bool:
        nonlocal said
        said += capsys.readouterr().err
        return bool(said)

    with RunProgress("flights", first_line_s=0.02) as flights:
        eventually(read, what="the first line")
        flights.update(0, 7)
        flights.update(7, 7)
    assert said == "flights: opening what they need\n"
    assert re.fullmatch(r"flights: 7 of 7 in 0:00:\d\d\n", capsys.readouterr().err)


def test_compare_loads_what_it_flies_with_where_it_flies():
    """What scores the flights takes seconds to load, and the first line would wait for it."""
    code = "import sys, hvt_study.commands.compare; print(*{'scipy.stats', 'rerun'} & {*sys.modules})"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "\n"


@pytest.mark.parametrize(
    ("steps", "now_s", "left_s"),
    [
        *(([(100.0, 1), (110.0, 2), (140.0, 5)], now_s, left_s) for now_s, left_s in ((145, 40), (200, 80))),
        *(([(0.0, 0)], 50, 0), ([(20.0, 1), (20.1, 2)], 50, 0)),
    ],
)
def test_the_time_left_is_that_of_the_last_steps(steps, now_s, left_s):
    """Two hours would be told of what takes one; of the first steps, which end together, nothing is concluded."""
    assert time_left_s(deque(steps), 9, now_s) == pytest.approx(left_s)


def test_of_what_is_unlike_the_rest_no_time_left_is_told(capsys):
    """The runs of most flights go first: by them ten minutes would take hours."""
    with RunProgress("runs", first_line_s=60) as runs:
        for done in range(19):
            runs.update(done, 40, alike=done in range(1, 5) or done > 15)
    assert "left" not in capsys.readouterr().err
    with RunProgress("runs", first_line_s=60) as runs:
        for done in range(20):
            runs.update(done, 40, alike=done > 15)
    assert re.fullmatch(r"runs: 19 of 40 in \S+, .* left\n", capsys.readouterr().err)


def test_who_waits_for_one_long_run_reads_how_far_all_is(capsys):
    """A comparison was silent for as long as its longest run."""
    said = ""

    def read() -> bool:
        nonlocal said
        said += capsys.readouterr().err
        return said.count("runs: 3 of 7 in 0:") > 2

    with RunProgress("runs", first_line_s=0.02, line_every_s=0.02) as runs:
        runs.update(3, 7)
        eventually(read, what="lines while nothing ends")


@pytest.mark.parametrize(("left_s", "says"), [(44.0, "less than a minute"), (50.0, "about 0:00:50")])
def test_near_the_end_no_seconds_are_told(capsys, monkeypatch, left_s, says):
    """Who waits would read of 14 seconds while four are left, or while forty are."""
    monkeypatch.setattr(output, "time_left_s", lambda *_: left_s)
    with RunProgress("flights", first_line_s=60) as flights:
        flights.update(6, 7)
    assert capsys.readouterr().err.endswith(f", {says} left\n")


def test_a_refused_command_leaves_no_folder(tmp_path):
    """Each mistyped call left an empty one."""
    mine = tmp_path / "mine"
    mine.mkdir()
    for folder in (mine, tmp_path / "a" / "b"):
        assert check_out(folder, name="t.json") == folder / "t.json"
    assert [*tmp_path.iterdir()] == [mine]
    with writing(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "t.json").write_text("")
    with pytest.raises(UserError, match="File name too long"):
        check_out(tmp_path / ("x" * 300), name="t.json")
