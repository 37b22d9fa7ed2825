"""hvt-ground with input that it cannot use."""

import shlex
from pathlib import Path

import pytest

from hvt_archive.replay.message_log import MessageLog
from hvt_common.redaction import redacted
from hvt_common.transport.inbox import Received
from media.onnx_models import colour_classifier


@pytest.fixture
def ground(refused, free_port):
    """Refuse settings on top of a run that would otherwise work, and end by itself."""

    def ground(*settings, code=2):
        listen = () if "--listen" in settings else ("--listen", f"tcp/127.0.0.1:{free_port}")
        return refused("hvt-ground", *listen, "--once", "--wait", "1s", *settings, code=code)

    return ground


def test_a_failed_start_leaves_nothing_behind_and_an_old_recording_as_it_was(ground, here):
    """The next start would number its files on, or yesterday's flight be lost."""
    for record in ("flight.rrd", "recordings"):
        ground("--listen", "tcp/0.0.0.0:7999", "--record", record, "--summary", "s.json")
    Path("flight.rrd").write_bytes(b"yesterday")
    ground("--listen", "tcp/0.0.0.0:7999", "--record", "flight.rrd")
    assert Path("flight.rrd").read_bytes() == b"yesterday"


@pytest.mark.parametrize(
    ("flag", "path"),
    [
        ("--record", "missing/flight.rrd"),
        ("--record", "notes.txt"),
        ("--record", "/proc/flight.rrd"),
        ("--record", "/proc/flights"),
        ("--record", "notes.txt/flights"),
        ("--ts", "missing/flight.ts"),
        ("--ts", "/proc/flight.ts"),
        ("--ts", "notes.txt"),
        ("--ts", "missing"),
        ("--ts", "udp://host:0"),
        ("--ts", "rtp://host:5600"),
        ("--summary", "missing/s.json"),
        ("--summary", "folder"),
        ("--summary", "/proc/s.json"),
    ],
)
def test_a_file_that_cannot_be_written(ground, here, flag, path):
    """The flight would be over before anybody sees that it was not kept."""
    Path("notes.txt").write_text("not a recording")
    Path("folder").mkdir()
    # A folder that is missing may be of a disk that is mounted later: a supervisor starts the ground again.
    code = 1 if path.startswith("missing/") or path == "/proc/flights" else 2
    assert f"{flag} {redacted(path)}" in ground(flag, path, code=code)


@pytest.mark.parametrize(
    ("flag", "value", "accepted"),
    [
        ("refine", "guess", "replace, fuse"),
        ("detect-every", "0", "1 to 1000"),
        ("threads", "many", "whole number from 1"),
        ("confidence", "2", "0.01 to 1"),
        ("camera-motion", "yes", "off, flow"),
        ("wait", "-1s", "2s"),
        ("split", "0", "1h, 14days or 200GB"),
        ("split", "0h", "at least 1s"),
        ("split", "10kB", "at least 1s or 1MB"),
        ("keep", "3parsecs", "14days or 200GB"),
        ("keep", "14", "14days or 200GB"),
        ("keep", "-1h", "14days or 200GB"),
        ("keep-video", "3GB", "12h or 3days"),
    ],
)
def test_a_value_that_is_not_accepted(ground, flag, value, accepted):
    """The user would have to read the source to learn what the setting takes."""
    sentence = ground(f"--{flag}", value)
    assert f"--{flag} '{value}'" in sentence
    assert accepted in sentence


KEEPS = "--record here --keep"
PLACES = (
    "takserver", "http://takserver:80", "udp://239.2.3.1", "tls://:8089", "tcp://[::1]:8087", "tcp://a:0",
    "tcp://a:70000", "tcp://a:1/path", "tcp://me:secret@a:1", "udp://a b:1",
)  # fmt: skip


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--keep 14days", ["--keep 1209600s needs a folder of recordings, and --record is not given"]),
        ("--keep 14days --record flight.rrd", ["--record flight.rrd is a file: give --record FOLDER/"]),
        ("--keep-video 1h --record flight.rrd", ["--keep-video 3600s needs a folder"]),
        (f"{KEEPS} 1h --keep 2h", ["--keep 3600s and --keep 7200s are both given"]),
        (f"{KEEPS} 1GB --keep 2GB", ["both given: give one time and one size"]),
        *((f"--listen tcp/{host}:7999", [host, "--insecure"]) for host in ("0.0.0.0", "[::]")),
        *((f"--edges '{pattern}'", [f"--edges '{pattern}'"]) for pattern in ("UAV_*", "a/b", "**/x")),
        ("--group 'A B'", ["--group 'A B'"]),
        ("--view --serve", ["--view and --serve are both given"]),
        *((word, [word]) for word in ("--bogus", "stray")),
        *((f"--cot '{url}'", [redacted(url), "--cot", "tls://HOST:PORT"]) for url in PLACES),
    ],
)
def test_words_that_cannot_be_meant_so(ground, words, told):
    """What was asked for would silently not count: nothing kept, nobody heard, an empty map, a door open to all."""
    sentence = ground(*shlex.split(words))
    assert [one for one in told if one not in sentence] == []


def test_a_classifier_with_no_class_in_common(ground, tmp_path):
    """It would fly, and never say a word of any track."""
    names = tmp_path / "fruit.txt"
    names.write_text("apple\npear\nplum\n")
    fruit = colour_classifier(tmp_path / "fruit.onnx")
    sentence = ground("--classifier", str(fruit), "--labels", str(names))
    assert f"--classifier {fruit} has no class in common with --detector aerial-nano" in sentence
    assert "apple, pear, plum; tracks are car, van" in sentence


def test_types_without_anybody_to_tell_and_types_that_are_none(ground, monkeypatch):
    """Symbols would be those of the defaults, and nobody know why; a certificate be missed at the first message."""
    Path("types.toml").write_text('[classes]\ncar = "a vehicle"\n', encoding="utf-8")
    monkeypatch.delenv("PYTAK_TLS_CLIENT_CERT", raising=False)
    udp = ("--cot", "udp://127.0.0.1:9", "--cot-types")
    for words, says in (
        (("--cot-types", "types.toml"), "give --cot too"),
        ((*udp, "types.toml"), "car = 'a vehicle' is no Cursor on Target type"),
        ((*udp, "nowhere.toml"), "cannot be read"),
        (("--cot", "tls://127.0.0.1:8089"), "PYTAK_TLS_CLIENT_CERT"),
    ):
        assert says in ground(*words)


@pytest.mark.parametrize("flag", ["--summary", "--timing", "--log", "--tracks", "--mcap", "--ts", "--record"])
def test_an_output_over_what_is_read(ground, here, flag):
    """The model, or the file of settings, would be gone with the first flight."""
    suffix = {"--tracks": "csv", "--mcap": "mcap", "--ts": "ts", "--record": "rrd"}.get(flag, "json")
    model, out = colour_classifier(Path("model.onnx")), Path(f"out.{suffix}")
    before = model.read_bytes()
    out.symlink_to(model)
    assert f"{flag} {out} is model.onnx itself" in ground("--classifier", "model.onnx", flag, str(out))
    assert model.read_bytes() == before
    settings = Path("settings.toml")
    settings.write_text("quiet = true\n")
    out.unlink()
    out.hardlink_to(settings)
    assert f"{flag} {out} is settings.toml itself" in ground("--config", "settings.toml", flag, str(out))
    assert settings.read_text() == "quiet = true\n"


@pytest.mark.parametrize("flag", ["--summary", "--timing", "--tracks", "--record"])
def test_a_replay_over_its_own_log(refused, here, flag):
    """What was received would be gone before it is read."""
    suffix = {"--tracks": "csv", "--record": "rrd"}.get(flag, "json")
    log, out = Path("flight.hvtlog"), Path(f"out.{suffix}")
    file = MessageLog(log, most_bytes=10**6)
    file.log(Received("hvt/uav-1/status", b"x", b"", "", 1))
    file.close()
    out.symlink_to(log)
    before = log.read_bytes()
    assert f"{flag} {out} is {log} itself" in refused("hvt-ground", "replay", str(log), flag, str(out))
    assert log.read_bytes() == before
