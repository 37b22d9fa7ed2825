"""Checks before a flight."""

import io
import json
import logging
import socket
import sys
import threading
from pathlib import Path

import pytest

from hvt_common.errors import NotYetError, UserError
from hvt_common.runtime.host_names import check_port
from hvt_common.runtime.reporting import check_folder
from hvt_fleet.checkup import Finding, check_clock, print_findings, run_checks
from programs.processes import eventually


def refused() -> Finding:
    raise UserError("camera /dev/video9 is not there: name one that is")


def logged(text: str) -> Finding:
    logging.getLogger("hvt_common.some.part").warning("%s", text)
    return Finding("ok", "the keys are there")


def broken() -> Finding:
    raise ZeroDivisionError("division by zero")


HUNG: list[threading.Thread] = []


class Patient(threading.Thread):
    """Is waited for until it has ended, or hangs."""

    def join(self, timeout: float | None = None) -> None:
        assert timeout == 0.3
        eventually(lambda: self in HUNG or not self.is_alive())


def hanging() -> Finding:
    HUNG.append(threading.current_thread())
    return Finding("ok", str(threading.Event().wait()))


def test_one_that_fails_or_hangs_keeps_no_other_from_its_answer(monkeypatch):
    """A camera that hangs would hide that the disk is full."""
    monkeypatch.setattr(threading, "Thread", Patient)
    checks = {
        "camera": refused,
        "bug": broken,
        "hangs": hanging,
        "last": lambda: Finding("ok", "it was checked"),
    }
    found = run_checks(checks, patience_s=0.3)
    assert found["camera"] == Finding("wrong", "camera /dev/video9 is not there", "name one that is")
    assert (found["bug"].state, found["bug"].found) == ("wrong", "ZeroDivisionError: division by zero")
    assert (found["hangs"].state, found["hangs"].found) == ("wrong", "no answer within 0.3 s")
    warned = run_checks({"keys": lambda: logged("this key can be read by all")}, patience_s=0.3)["keys"]
    assert (warned.state, warned.todo) == ("warning", "this key can be read by all")
    assert found["last"] == Finding("ok", "it was checked")


def test_only_what_is_wrong_fails_and_each_says_what_to_do(capsys):
    """A script would fly without a camera, or not fly for want of a time service."""
    warned = {"clock": Finding("warning", "not synchronised", "start chrony")}
    assert print_findings("doctor", warned, as_json=False) == 0
    said = capsys.readouterr().out
    assert said.index("not synchronised") < said.index("What to do:") < said.index("start chrony")
    wrong = {**warned, "camera": Finding("wrong", "gone [really]", "plug it in")}
    assert print_findings("doctor", wrong, as_json=True) == 2
    rows = json.loads(capsys.readouterr().out)
    assert [(row["check"], row["state"]) for row in rows] == [("clock", "warning"), ("camera", "wrong")]
    assert print_findings("doctor", wrong, as_json=False) == 2
    assert "gone [really]" in capsys.readouterr().out


def test_an_answer_that_a_full_disk_does_not_take_is_no_success(monkeypatch):
    """The script that reads the file would take an empty one for a sound edge."""
    with Path("/dev/full").open("wb", buffering=0) as full:
        monkeypatch.setattr("sys.stdout", io.TextIOWrapper(full, write_through=True))
        with pytest.raises(OSError, match="No space left"):
            print_findings("doctor", {"clock": Finding("ok", "set")}, as_json=True)
        sys.stdout.detach()


def test_ports_folders_and_the_clock(tmp_path):
    """They would be found out in the field."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(UserError, match="Address already in use"):
            check_port(f"127.0.0.1:{taken.getsockname()[1]}", name="--metrics")
    for nonsense in ("nowhere", "127.0.0.1:http", "127.0.0.1:70000000"):
        with pytest.raises(UserError, match="give HOST:PORT"):
            check_port(nonsense, name="--metrics")
    assert check_folder(tmp_path / "not" / "yet", name="--record") == tmp_path
    (tmp_path / "file").write_bytes(b"")
    for path, kind in ((tmp_path / "file", UserError), (tmp_path / "file" / "mounted later", NotYetError)):
        with pytest.raises(kind, match="is no folder that can be written") as refused_folder:
            check_folder(path, name="--record")
        assert refused_folder.type is kind
    assert check_clock().state in ("ok", "warning", "unknown")
