"""What people write is refused in a sentence, also where the system does not even let it be looked at."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hvt_common import files
from hvt_common.config import load
from hvt_common.errors import NotYetError, Parser, UserError, exit_with_sentence, may_come, named_path
from hvt_common.files import read_text
from hvt_common.inference.labels import read_labels
from hvt_common.transport.zenoh_config import LinkSettings, key_pair
from hvt_edge.config import EdgeConfig
from hvt_study.datasets.annotation_rows import label_text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a" * 300, r"--out 'a+' cannot be looked at \(File name too long\)"),
        ("{folder}/loop/x", r"cannot be looked at \(Too many levels of symbolic links\)"),
        ("-", "--out '-' is a standard stream elsewhere"),
        ("~nobody-of-that-name/x", "begins with a user that this machine does not know"),
    ],
)
def test_a_path_that_nobody_can_look_at_is_refused(tmp_path, text, says):
    """Each option that names a file would end with a traceback: `Path.exists` raises."""
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(UserError, match=says) as caught:
        named_path(text.format(folder=tmp_path), name="--out")
    assert not isinstance(caught.value, NotYetError)
    assert named_path(str(tmp_path / "not there" / "x")) == tmp_path / "not there" / "x"


@pytest.mark.parametrize(("number", "kind"), [(errno.EACCES, UserError), (errno.ESTALE, NotYetError)])
def test_a_disk_that_does_not_answer_may_come_back_and_a_closed_folder_does_not(monkeypatch, number, kind):
    """A supervisor would start a program for ever that may not read its file, or never again after a broken mount."""
    monkeypatch.setattr(Path, "stat", lambda *_, **__: (_ for _ in ()).throw(OSError(number, "no")))
    with pytest.raises(UserError) as caught:
        named_path("x")
    assert type(caught.value) is kind


def test_what_is_used_up_may_be_free_again():
    """A camera or a port would be given up for a moment without descriptors."""
    assert all(may_come(OSError(number, "no")) for number in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS))


def test_a_command_checks_its_files_too():
    """``keys --dir`` and ``recordings list`` would show a traceback where the service says a sentence."""
    parser = Parser(prog="x")
    parser.add_subparsers().add_parser("list").add_argument("folder", type=Path)
    with pytest.raises(UserError, match="cannot be looked at"):
        parser.parse_args(["list", "a" * 300])


@pytest.mark.parametrize(
    ("kind", "text", "says"),
    [
        (
            Path,
            "",
            "argument --it: '' is empty",
        ),  # --out "$OUT" without OUT wrote into the folder that it ran in
        # --class "$CLASS" without CLASS was an empty table, which says that there is none
        (None, " ", "argument --it: ' ' is empty: leave it out or give it a value"),
        (int, "1e3", "argument --it: '1e3' is not accepted: give a whole number; see x --help"),
        (float, "3s", "argument --it: '3s' is not accepted: give a number"),
    ],
)
def test_a_command_says_what_it_accepts(kind, text, says):
    """It spoke of Python's types."""
    parser = Parser(prog="x")
    command = parser.add_subparsers(metavar="COMMAND").add_parser("do", prog="x")
    command.add_argument("--it", type=kind)
    with pytest.raises(UserError, match=says):
        parser.parse_args(["do", "--it", text])


ENDLESS = Path("/dev/zero")


@pytest.mark.skipif(not ENDLESS.exists(), reason="there is no file without an end")
@pytest.mark.parametrize(
    "read",
    [
        read_text,
        lambda path: load(EdgeConfig, ["--config", str(path)], program="hvt-edge", description=""),
        lambda path: key_pair(LinkSettings(role="edge", zenoh_config=path)),
        read_labels,
    ],
    ids=["text", "config", "zenoh-config", "labels"],
)
def test_a_file_without_an_end_is_refused(read):
    """The process grew until its system ended it."""
    with pytest.raises((OSError, UserError)) as raised:
        read(ENDLESS)
    assert "larger than 16 MB" in str(raised.value) or "not a file" in str(raised.value)


def test_a_pipe_is_read_to_its_end_and_where_nobody_writes_no_further(monkeypatch, tmp_path):
    """The start would hang, deaf to Ctrl-C; or ``--config <(…)`` be half of what it says."""
    reading, writing = os.pipe()
    with os.fdopen(writing, "wb") as writer:
        writer.write(b"edge-id")
    assert read_text(Path(f"/proc/self/fd/{reading}")) == "edge-id"
    os.close(reading)
    monkeypatch.setattr(files, "PIPE_WAIT_S", 0.0)
    os.mkfifo(pipe := tmp_path / "pipe")
    with pytest.raises(OSError, match="into which nobody writes"):
        read_text(pipe)


def test_text_is_read_as_its_byte_order_mark_says(tmp_path):
    """A file that an editor of another system has saved would be refused, or read as other letters."""
    file = tmp_path / "file.txt"
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        file.write_text("Straße", encoding=encoding)
        assert read_text(file) == label_text(file) == "Straße"
    file.write_bytes(b"car\xff")
    with pytest.raises(OSError, match="not UTF-8 text at byte 3"):
        read_text(file)


_PROGRAM = """
import sys
from hvt_common.errors import exit_with_sentence
from hvt_common.runtime.process import leave
def run(argv):
    with open(argv[0], "wb"):
        pass
    first = open(argv[0], "wb")
    print("said", file=sys.stderr, flush=True)
    print(first.fileno())
    return 0
leave(exit_with_sentence(run, program="it", argv=sys.argv[1:]))
"""


def test_streams_that_were_closed_take_no_files(tmp_path):
    """A ground started by a daemon wrote a decoder's warnings into its recording, and ended with 1 after a flight."""
    words = [sys.executable, "-c", _PROGRAM, str(tmp_path / "recording")]
    for closed in ("<&-", ">&-", "2>&-", "<&- >&- 2>&-"):
        done = subprocess.run(["sh", "-c", f'"$@" {closed}', "sh", *words], capture_output=True, check=True)
        assert int(done.stdout or 3) > 2, f"with {closed} a file has the number of a standard stream"
    assert (tmp_path / "recording").read_bytes() == b""


@pytest.mark.parametrize(
    ("locale", "shown"),
    [
        ({"PYTHONIOENCODING": "latin-1"}, b"\xfc?\n"),
        ({"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, "ü…\n".encode()),
    ],
)
def test_a_locale_without_utf_8_ends_nothing(locale, shown):
    """`hvt-edge --help` was a traceback there, for it has an ellipsis."""
    print_it = r"print('\xfc\u2026')"
    begin = "from hvt_common.errors import exit_with_sentence as run"
    program = f"{begin}; run(lambda _: {print_it}, program='', argv=[])"
    environment = {"PATH": os.environ["PATH"], **locale}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=False)
    assert (done.stdout, done.stderr) == (shown, b"")


_PARENT = """
import subprocess, sys
from hvt_common.errors import exit_with_sentence
def run(argv):
    child = "import os; [os.fstat(number) for number in range(3)]"
    return subprocess.run([sys.executable, "-c", child]).returncode
sys.exit(exit_with_sentence(run, program="it", argv=[]))
"""


def test_programs_that_it_starts_have_the_streams_too():
    """A file of theirs would have the number of a stream."""
    words = ["sh", "-c", '"$@" <&- >&- 2>&-', "sh", sys.executable, "-c", _PARENT]
    assert subprocess.run(words, capture_output=True, check=False).returncode == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_output_for_which_there_is_no_room_is_a_sentence(tmp_path):
    """Settings or a report sent to a file on a full disk ended in a traceback."""
    words = [sys.executable, "-c", _PROGRAM, str(tmp_path / "recording")]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    says = "it: a disk that it writes to is full (No space left on device): make room there"
    assert done.stderr.splitlines() == ["said", says]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize(("word", "full", "code"), [("--help", 1, 1), ("--version", 1, 1), ("--bogus", 2, 2)])
def test_where_nobody_can_read_what_it_says_the_exit_code_does(word, full, code):
    """The help was lost with code 0, and a wrong option was code 1, after which a supervisor starts it for ever."""
    words = [sys.executable, "-m", "hvt_ground.cli", word]
    done = subprocess.run(
        ["sh", "-c", f'"$@" {full}>/dev/full', "sh", *words], capture_output=True, check=False
    )
    assert (done.returncode, b"Traceback" in done.stderr) == (code, False)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        *(
            (error, 1, "the system gives it no more memory, threads or files (")
            for error in (
                MemoryError(),
                RuntimeError("can't start new thread"),
                OSError(errno.EMFILE, "Too many open files"),
                ImportError("/lib/zenoh.so: failed to map segment from shared object"),
            )
        ),
        (
            UserError(f"--size {'9' * 5000!r} and a\nb\udcff are not accepted: give é"),
            2,
            f"--size {repr('9' * 5000)[:300]}… and a\\nb\\udcff are not accepted: give é\n",
        ),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (KeyboardInterrupt(signal.SIGTERM), 143, "interrupted\n"),
    ],
)
def test_what_ends_a_program_is_a_sentence_in_a_line(error, code, said, capsys):
    """The user would read a traceback, a screen of nines, or nothing."""

    def run(_argv):
        raise error

    assert exit_with_sentence(run, program="it", argv=[]) == code
    told = capsys.readouterr().err
    assert told.startswith(f"it: {said}")
    assert told.count("\n") == 1
