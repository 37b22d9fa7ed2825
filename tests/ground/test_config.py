"""Every setting of hvt-ground, and the names of its recordings."""

import dataclasses
import errno
import fcntl
import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_common.files import has_nothing
from hvt_ground.config import GroundConfig
from hvt_ground.extras import Extra, all_extras, checked, config_class
from hvt_ground.wiring import check_outputs, make_folders, output_path, set_aside
from hvt_ground.wiring.sessions import backlog_path, free_path, open_again


def read(*argv: str) -> GroundConfig:
    return checked(load(config_class(), list(argv), program="hvt-ground", description="")[0])


def test_without_flags_it_listens_and_needs_no_model():
    """``hvt-ground`` alone would not start."""
    config = read()
    assert (config.detector, config.edges, config.refine, config.once) == ("aerial-nano", "*", "fuse", False)
    assert (config.listen, config.connect, config.record) == ((), (), None)


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--labels", "names.txt", "--classifier", "detector"], "--classifier is no file"),
        (["--timing", "a.csv", "--tracks", "./a.csv"], "--tracks and --timing both name a.csv: give each"),
        (["--timing", "a.csv", "--summary", "b/../a.csv"], "--summary and --timing both name a.csv"),
        (["--record", "a.rrd", "--summary", "a.rrd"], "--record and --summary both name a.rrd"),
        (["--ts", "a.ts", "--summary", "./a.ts"], "--summary and --ts both name a.ts"),
    ],
)
def test_settings_that_contradict_are_one_sentence(argv, said):
    """The user would guess which of two settings won."""
    with pytest.raises(UserError, match=said):
        read(*argv)


def test_folders_and_devices_may_be_named_twice(tmp_path):
    """``--record out --tracks out`` would be refused, though each file in it has a name of its own."""
    read("--record", str(tmp_path), "--tracks", str(tmp_path), "--timing", str(tmp_path / "a.csv"))
    read("--record", "out", "--tracks", "out")
    read("--ts", "udp://127.0.0.1:5600", "--summary", "udp:")
    read("--timing", "/dev/null", "--summary", "/dev/null")


def test_every_flag_explains_itself(capsys):
    """Somebody at a ground station would have to read the source."""
    with pytest.raises(SystemExit):
        load(config_class(), ["--help-all"], program="hvt-ground", description="")
    out = " ".join(capsys.readouterr().out.split())
    for one in dataclasses.fields(config_class()):
        assert "--" + one.name.replace("_", "-") in out
        assert len(one.metadata["help"]) > 8
    assert "[aerial-nano]" in out.replace("- ", "-"), "argparse breaks lines at hyphens"
    assert "[hvt-<edge>-<time>.rrd here]" in out


@pytest.mark.parametrize(
    ("option", "file"), [("record", "a.rrd"), ("tracks", "a.csv"), ("stills", "a.csv"), ("mcap", "a.mcap")]
)
def test_a_folder_that_is_not_there_is_made_and_a_file_of_another_kind_refused(tmp_path, option, file):
    """All tracks of a flight would be lost."""
    folder = tmp_path / "flights" / "today"
    config = read(f"--{option}", str(folder))
    check_outputs(config)
    assert not folder.exists(), "a start that is refused leaves nothing behind"
    make_folders(config)
    assert folder.is_dir()
    (tmp_path / "notes.txt").touch()
    for name in ("notes.txt", "absent.MP4"):
        with pytest.raises(UserError, match=f"--{option} .*{name} is neither a folder nor named {file[1:]}"):
            check_outputs(read(f"--{option}", str(tmp_path / name)))
    with pytest.raises(UserError, match=f"--{option} .* cannot be made"):
        make_folders(read(f"--{option}", str(tmp_path / "notes.txt" / "in")))


@pytest.mark.parametrize("words", [["--record", "./"], []])
@pytest.mark.parametrize(("flags", "refused"), [(0, True), (os.ST_RDONLY, False)])
def test_a_folder_of_somebody_else_is_refused(monkeypatch, words, flags, refused):
    """The flight would be recorded nowhere. A disk that is mounted read-only may be mended in flight."""
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=flags))
    said = pytest.raises(UserError, match=r"--record .* cannot be written to by this user")
    with said if refused else nullcontext():
        check_outputs(read(*words))


@pytest.mark.parametrize("words", ["--record a.rrd", "--log a", "--mcap a.mcap", "--ts a.ts", "--timing a"])
def test_a_file_in_a_folder_that_is_not_there_is_refused(words):
    """A flight would begin, and be written nowhere."""
    option, file = words.split()
    with pytest.raises(UserError, match=f"{option} absent/{file} is in a folder that does not exist"):
        check_outputs(read(option, f"absent/{file}"))


def test_no_recording_is_written_over_another(tmp_path):
    """A restart of the edge would destroy the recording of the flight before."""
    taken: set[Path] = set()
    folder = [output_path(tmp_path, suffix=".rrd", edge="uav-1", stamp="t", taken=taken) for _ in range(3)]
    assert [one.name for one in folder] == ["hvt-uav-1-t.rrd", "hvt-uav-1-t-1.rrd", "hvt-uav-1-t-2.rrd"]
    (tmp_path / "hvt-uav-2-t.rrd").touch()  # of an earlier process
    assert (
        output_path(tmp_path, suffix=".rrd", edge="uav-2", stamp="t", taken=taken).name == "hvt-uav-2-t-1.rrd"
    )
    named = tmp_path / "flight.rrd"
    named.touch()  # the user named it: it is written anew, once
    edges = ["uav-1", "uav-2", "uav-2", "uav-1"]
    names = [output_path(named, suffix=".rrd", edge=edge, stamp="t", taken=taken).name for edge in edges]
    assert names == ["flight.rrd", "flight-uav-2.rrd", "flight-uav-2-2.rrd", "flight-uav-1.rrd"]
    assert len(set(names)) == 4


def test_a_ground_that_is_started_again_keeps_what_it_wrote(tmp_path, caplog):
    """After a crash a supervisor starts it with the same names: the flight so far would be written over."""
    folder = tmp_path / "a b %d"
    folder.mkdir()
    files = ["f.rrd", "t.csv", "s.csv", "s-000012.png", "l.hvtlog", "l-before.hvtlog", "m.csv", "o.mcap"]
    for one in files:
        (folder / one).write_text(one)
    others = ["f-uav-2.rrd", "f-before.rrd", "sum.json", "s-x.png", "s-1.png", "t-000012.png", "m-before.csv"]
    for one in others:
        (folder / one).write_text(one)
    words = ["--record f.rrd", "--tracks t.csv", "--stills s.csv", "--log l.hvtlog", "--timing m.csv"]
    given = [word.split() for word in [*words, "--mcap o.mcap", "--summary sum.json", "--ts new.ts"]]
    set_aside(read(*(word for option, name in given for word in (option, str(folder / name)))))
    (earlier,) = folder.glob("earlier-*")
    assert {one.name: one.read_text() for one in earlier.iterdir()} == {one: one for one in files}
    assert {one.name for one in folder.iterdir()} == {*others, earlier.name}
    assert f"--record {folder / 'f.rrd'} was there already: it is {earlier / 'f.rrd'} now" in caplog.text


def test_on_a_full_disk_it_keeps_what_it_wrote_too(tmp_path, monkeypatch):
    """That is what it may have died of, and a folder takes a block."""

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "mkdir", full)
    (tmp_path / "f.rrd").write_text("flight")
    set_aside(read("--record", str(tmp_path / "f.rrd")))
    assert [one.read_text() for one in tmp_path.glob("earlier-*-f.rrd")] == ["flight"]


def test_what_was_moved_stays_where_each_start_is_of_the_same_time(tmp_path, monkeypatch):
    """A machine without a clock of its own boots at the same second each time: one flight would replace the other."""
    monkeypatch.setattr("time.strftime", lambda *_: "19700101-000030")
    flights = ["1", "2", "3"]
    for one in flights:
        (tmp_path / "f.rrd").write_text(one)
        set_aside(read("--record", str(tmp_path / "f.rrd")))
    assert sorted(one.read_text() for one in tmp_path.glob("earlier-*/f.rrd")) == flights


def test_nothing_is_moved_from_under_a_ground_that_still_writes_it(tmp_path, caplog):
    """A second one that is started by mistake took its files from under the first."""
    for one in ("f.rrd", "t.csv", "o.mcap"):
        (tmp_path / one).write_text(one)
    with (tmp_path / "t.csv").open() as table, (tmp_path / "o.mcap").open() as other:
        for one in (table, other):
            fcntl.flock(one, fcntl.LOCK_EX)
        words = ["--record f.rrd", "--tracks t.csv", "--mcap o.mcap"]
        given = [word.split() for word in words]
        set_aside(read(*(word for option, name in given for word in (option, str(tmp_path / name)))))
    (earlier,) = tmp_path.glob("earlier-*")
    assert {one.name for one in tmp_path.iterdir()} == {"t.csv", "o.mcap", earlier.name}
    assert [one.name for one in earlier.iterdir()] == ["f.rrd"]
    assert f"--tracks {tmp_path / 't.csv'} is another program's, which writes it now" in caplog.text


def test_what_another_ground_has_written_is_never_written_over(tmp_path, monkeypatch):
    """A second one was refused the files of the first, and its next try took their contents once that had ended."""
    named, second = tmp_path / "f.rrd", {"suffix": ".rrd", "edge": "uav-1", "stamp": "t"}
    kept, taken = [], set()

    def refused(path: Path) -> None:
        path.write_text("of another ground")  # between the choice of the name and the opening
        raise UserError("another program is at work on it")

    def name(**more: bool) -> str:
        return output_path(named, taken=set(), **second, **more).name

    with pytest.raises(UserError):
        open_again(named, taken, refused)
    for _ in range(2):
        open_again(named, taken, kept.append)
    assert [one.name for one in kept] == ["f-2.rrd", "f-3.rrd"]
    assert name() == "f-uav-1.rrd"
    with pytest.raises(UserError):
        open_again(named, set(), refused)
    assert (tmp_path / "f-4.rrd").exists(), "nor is it removed"
    assert name(claim=False) == "f.rrd", "the beginning of f-0001.rrd"
    named.write_text("")
    with named.open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert name() == "f-uav-1-2.rrd"
    assert name() == "f.rrd"
    named.write_text("of a flight that cannot be moved")
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert name() == "f.rrd", "where the folder takes no other, this flight would not be recorded"


def test_two_grounds_of_one_folder_never_get_one_name(tmp_path):
    """Both would write one file, and neither flight could be read."""
    names = [output_path(tmp_path, suffix=".rrd", edge="uav-1", stamp="t", taken=set()) for _ in range(3)]
    late = [backlog_path(tmp_path, edge="uav-1", stamp="t", taken=set()) for _ in range(3)]
    numbered = [free_path([tmp_path / "timing.csv"], set(), number=2) for _ in range(3)]
    assert len({*names, *late, *numbered}) == 9
    (tmp_path / "t.rrd").symlink_to(tmp_path / "nowhere")  # a link that leads nowhere is a name that is taken
    assert free_path([tmp_path / "t.rrd"], set(), number=2).name == "t-2.rrd"


def test_the_beginning_of_names_is_no_file(tmp_path):
    """With --split an empty file of the session's name would stand beside its parts, and be nobody's recording."""
    for _ in range(2):
        output_path(tmp_path, suffix=".rrd", edge="uav-1", stamp="t", taken=set(), claim=False)
    assert not list(tmp_path.iterdir())


def test_a_device_is_never_taken_for_an_empty_file(tmp_path):
    """A ground of root with --record /dev/full would remove it."""
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    (tmp_path / "empty").touch()
    os.mkfifo(tmp_path / "pipe")
    nothing = {one.name: has_nothing(one) for one in sorted(tmp_path.iterdir())}
    assert nothing == {"empty": True, "link": False, "pipe": False}
    assert not has_nothing(Path("/dev/full"))
    assert has_nothing(tmp_path / "new")


def test_an_extra_needs_no_settings() -> None:
    """One that brings a sink alone would end each start with a traceback."""
    assert config_class((Extra(), *all_extras(), Extra())) is not None
