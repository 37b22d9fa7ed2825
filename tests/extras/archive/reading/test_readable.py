"""What of a recording can be read: the SDK is asked as seldom as may be, for it may never answer."""

import os
import signal
import subprocess

import pytest
import rerun as rr

from hvt_archive.reading.readable import _Tries, readable, tried
from programs.rrd import damaged

ROWS = 300


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> bytes:
    """Of a recording with a chunk for each row, and a footer."""
    path = tmp_path_factory.mktemp("whole") / "whole.rrd"
    with rr.RecordingStream("hvt-uav-1", recording_id="uav-1-00ff") as stream:
        stream.save(path)
        for row in range(ROWS):
            stream.set_time("frame", sequence=row)
            stream.log("/row", rr.AnyValues(number=row))
            stream.flush()
    return path.read_bytes()


def _whole(data: bytes) -> bytes:
    return data


def _cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _hole(data: bytes) -> bytes:
    return damaged(data, b"/row")


def _nobodys(data: bytes) -> bytes:
    return data[:28] + b"\xff" * 40 + data[68:]


def _all_bad(data: bytes) -> bytes:
    while b"/row" in data[:-20_000]:
        data = data.replace(b"/row", b"\xff\xff\xff\xff")
    return data


@pytest.mark.parametrize(
    ("damage", "read", "most"),
    [
        (_whole, "whole", 1),
        (_cut, "copy", 3),
        (_hole, "copy", 30),
        (_nobodys, None, 2),
        pytest.param(_all_bad, None, 103, marks=pytest.mark.nightly),
    ],
)
def test_the_sdk_is_asked_seldom(data, tmp_path, monkeypatch, damage, read, most):
    """A store info that was damaged cost six thousand tries, and a file that was merely cut was read twice."""
    path, out = tmp_path / "whole.rrd", tmp_path / "copy.rrd"
    path.write_bytes(damage(data))
    tries = []
    fork = os.fork
    monkeypatch.setattr(os, "fork", lambda: tries.append(1) or fork())
    found = tried(path, out)
    assert len(tries) <= most
    assert {b"0": "whole", b"1": "copy", b"2": None}[found] == read
    assert readable(path, out) == {"whole": path, "copy": out, None: None}[read]


def test_who_tries_stays_for_the_next_file(data, tmp_path, monkeypatch):
    """Each file of a folder would take as long as to import Rerun. One that was killed is replaced."""
    path, starts = tmp_path / "whole.rrd", []
    path.write_bytes(data)
    popen = subprocess.Popen
    monkeypatch.setattr(
        subprocess, "Popen", lambda *words, **how: starts.append(popen(*words, **how)) or starts[-1]
    )
    tries = _Tries()
    assert [tries.found(path, tmp_path / "copy.rrd") for _ in range(3)] == [b"0"] * 3
    assert len(starts) == 1
    starts[0].kill()
    assert tries.found(path, tmp_path / "copy.rrd") == b"0"
    tries.rest()
    assert len(starts) == 2
    assert [one.returncode for one in starts] == [-signal.SIGKILL] * 2, "one is left, or a zombie"
