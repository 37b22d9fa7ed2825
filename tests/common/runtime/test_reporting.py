"""What a run says of itself."""

import errno
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from hvt_common import files
from hvt_common.errors import FlightError, UserError, exit_with_sentence
from hvt_common.files import write_whole
from hvt_common.redaction import Redaction
from hvt_common.runtime import reporting
from hvt_common.runtime.log import Log
from hvt_common.runtime.reporting import (
    StatusLine,
    check_writable,
    flown,
    print_table,
    version_of,
    write_json,
)


def test_the_summary_file_is_written_whole(tmp_path):
    """A program that reads the summary would find half of one."""
    path = tmp_path / "summary.json"
    path.write_text("old and longer than the new content is")
    write_json(path, {"edge": "uav-1", "frames": 3})
    assert json.loads(path.read_text()) == {"edge": "uav-1", "frames": 3}
    assert list(tmp_path.iterdir()) == [path]


def test_a_summary_goes_into_a_pipe_and_through_a_link(tmp_path):
    """A script that reads it would wait for ever; a link would become a file on the wrong disk."""
    os.mkfifo(pipe := tmp_path / "pipe")
    got = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()))
    reader.start()
    write_json(pipe, [{"edge": "uav-1"}])
    reader.join(60)
    assert json.loads(got[0]) == [{"edge": "uav-1"}]
    assert pipe.is_fifo()
    (tmp_path / "disk").mkdir()
    link, file = tmp_path / "summary.json", tmp_path / "disk" / "summary.json"
    link.symlink_to(file)
    for frames in (1, 2):
        write_json(link, {"frames": frames})
        assert link.is_symlink()
        assert json.loads(file.read_text()) == {"frames": frames}


class Side:
    """Its flight breaks off, and another run may end meanwhile."""

    def __init__(self, summary, meanwhile):
        self._summary, self._meanwhile = summary, meanwhile

    def run(self):
        self._meanwhile()
        raise FlightError("it breaks off", summary=self._summary)

    def in_hand(self):
        return frozenset()

    def given_up(self):
        return FlightError("it hangs")


def run_of(path, summary, *, other):
    shown = []
    with pytest.raises(FlightError, match="breaks off"):
        flown(
            Side(summary, other),
            threading.Event(),
            log=cast("Log", SimpleNamespace(redaction=Redaction(), as_json=False)),
            path=path,
            show=shown.append,
        )
    assert shown == [summary]


def test_of_two_runs_at_once_none_loses_its_summary(tmp_path, caplog, monkeypatch):
    """The second ground of a script would replace the first one's; a script that runs again replaces the old one."""
    path, second = tmp_path / "summary.json", tmp_path / "summary-2.json"
    others = (list, list, lambda: write_json(path, {"run": 2}))
    for number, other in zip((0, 1, 3), others, strict=True):
        assert not second.exists()
        run_of(path, {"run": number}, other=other)
    assert [json.loads(one.read_text())["run"] for one in (path, second)] == [2, 3]
    assert caplog.messages == [f"another run has written {path} meanwhile: this summary is in {second}"]
    before = version_of(path)

    def written(file, content):
        monkeypatch.undo()
        write_json(path, {"run": 5}, before=before)  # ends while the other one is about to write
        write_whole(file, content)

    monkeypatch.setattr(reporting, "write_whole", written)
    write_json(path, {"run": 4}, before=before)
    runs = {one.name: json.loads(one.read_text())["run"] for one in tmp_path.iterdir()}
    assert runs == {"summary.json": 4, "summary-2.json": 3, "summary-3.json": 5}


def test_a_summary_on_standard_output_stands_behind_what_was_printed(tmp_path):
    """``--summary /dev/stdout > run.txt``, of root, replaced the system's /dev/stdout by a file."""
    link = tmp_path / "stdout"
    link.symlink_to("/dev/fd/1")
    program = (
        "import sys; from pathlib import Path; from hvt_common.runtime.reporting import version_of, write_json;"
        "path = Path(sys.argv[1]); before = version_of(path);"
        "print('table', flush=True); write_json(path, {}, before=before); print('end')"
    )
    with (tmp_path / "run.txt").open("w") as output:
        subprocess.run([sys.executable, "-c", program, str(link)], stdout=output, check=True)
    assert (tmp_path / "run.txt").read_text() == "table\n{}\nend\n"
    assert link.is_symlink()


def test_a_summary_into_a_pipe_that_nobody_reads_is_a_sentence(tmp_path, monkeypatch):
    """The program never ended, and no signal ended it but by force."""
    monkeypatch.setattr(files, "PIPE_WAIT_S", 0.0)
    os.mkfifo(pipe := tmp_path / "pipe")
    with pytest.raises(FlightError, match=r"pipe cannot be written \(No such device or address\)"):
        write_json(pipe, {})


def test_files_that_cannot_be_written_are_refused_before_the_run(tmp_path):
    """An hour's flight would end without its summary; or the check lose yesterday's."""
    check_writable(None, name="--summary")
    check_writable(tmp_path / f"{'new' * 61}12.json", name="--summary")
    (there := tmp_path / "s.json").write_text("yesterday")
    check_writable(there, name="--summary")
    assert there.read_text() == "yesterday"
    for path, said in (
        (tmp_path, "is a folder: name a file"),
        (tmp_path / "none" / "s.json", "is in a folder that does not exist: make "),
        # The file of a second session, with the edge's id behind it, could not be written.
        (tmp_path / f"{'é' * 93}.json", "has a name of 191 bytes: give one of at most 190, "),
    ):
        with pytest.raises(UserError, match=said):
            check_writable(path, name="--summary")


def test_a_table_says_paths_and_names_as_they_are(monkeypatch, capsys):
    """A folder called [run 1] would vanish from the table, or a narrow terminal cut words."""
    print_table("uav[/]1", [("recording", "/data/[run 1]/[/bold]:car:.rrd"), ("[red]", "x")])
    out = capsys.readouterr().out
    assert [one for one in ("/data/[run 1]/[/bold]:car:.rrd", "uav[/]1", "[red]") if one not in out] == []
    monkeypatch.setenv("COLUMNS", "24")
    print_table("uav-1", [("not sent yet", "15 objects")])
    assert "…" not in capsys.readouterr().out


def test_a_log_gets_a_line_now_and_then(capsys):
    """A service's log would have a line a second; with --quiet any at all."""
    for quiet in (False, True):
        with StatusLine(quiet=quiet) as line:
            for number in range(11):
                line.show(f"frame {number}")
            line.note("[note] :wave:")
        err = capsys.readouterr().err
        assert err.splitlines() == ([] if quiet else ["frame 0", "frame 5", "frame 10", "[note] :wave:"])


def test_a_result_that_cannot_be_written_is_a_sentence_and_code_1(tmp_path, capsys):
    """After an hour's flight a traceback would be all that is left; or a supervisor never start it again."""

    def flight(_argv):
        write_json(tmp_path / "gone" / "summary.json", {})
        return 0

    assert exit_with_sentence(flight, program="hvt-edge", argv=[]) == 1
    said = capsys.readouterr().err
    assert said == f"hvt-edge: {tmp_path}/gone/summary.json cannot be written (No such file or directory)\n"


def test_a_disk_without_room_leaves_no_half_of_a_summary(tmp_path, monkeypatch):
    """Each start of a service on a full disk would leave an empty file there."""

    def full(path, *_, **__):
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FlightError, match="No space left on device"):
        write_json(tmp_path / "summary.json", {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("reader", "unbuffered"), [("true", ""), ("head -1", "1")])
def test_a_reader_that_leaves_ends_the_program_without_a_word(reader, unbuffered):
    """``hvt-models list | head`` would end in a traceback."""
    program = (
        "from hvt_common.errors import exit_with_sentence as run\n"
        "def say(argv):\n"
        "    for line in range(100_000): print(line)\n"
        "    return 0\n"
        "raise SystemExit(run(say, program='x', argv=[]))"
    )
    told = subprocess.run(
        ["bash", "-c", f'"$0" -c "$1" | {reader}; echo ${{PIPESTATUS[0]}}', sys.executable, program],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        check=True,
    )
    assert told.stderr == ""
    assert told.stdout.splitlines()[-1] == "1"


FLIGHT = """
import logging, sys
from pathlib import Path
from hvt_common.errors import exit_with_sentence
from hvt_common.runtime.log import start_log
from hvt_common.runtime.process import leave
from hvt_common.runtime.reporting import StatusLine, print_table, write_json
def fly(argv):
    log = start_log("it", quiet=False, form="text")
    with StatusLine(quiet=False) as line:
        for number in range(9):
            line.show(f"frame {number}")
        line.note("noted")
        logging.getLogger("hvt_edge").warning("warned")
    print_table("table", [("a", "b")])
    log.release()
    write_json(Path(argv[0]), {"frames": number})
    return 0
leave(exit_with_sentence(fly, program="it", argv=sys.argv[1:]))
"""


@pytest.mark.parametrize("full", [False, True], ids=["dead pipe", "full disk"])
def test_a_flight_goes_on_when_nobody_reads_its_status(tmp_path, full):
    """The video, or the recording, would end with the terminal or the log's disk from which it was started."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as dead, Path("/dev/full").open("wb") as disk:
        output = disk if full else dead
        words = [sys.executable, "-c", FLIGHT, str(tmp_path / "s.json")]
        done = subprocess.run(words, stdout=output, stderr=output, check=False)
    assert done.returncode == 0
    assert json.loads((tmp_path / "s.json").read_text()) == {"frames": 8}
