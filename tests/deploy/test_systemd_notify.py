"""What the programs tell systemd, on the socket that it gives them."""

import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hvt_common.runtime.process import notify_systemd
from programs.processes import PATIENT_S, Link

pytestmark = pytest.mark.integration


@contextmanager
def listening(name: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(name.replace("@", "\0", 1))
        bound.settimeout(PATIENT_S)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        yield bound


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with listening(str(tmp_path / "notify"), monkeypatch) as bound:
        yield bound


def test_a_socket_may_have_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where systemd uses an abstract one, a start would never end."""
    with listening(f"@hvt-{tmp_path}", monkeypatch) as bound:
        notify_systemd("READY=1")
        assert bound.recv(64) == b"READY=1"


def test_a_ground_is_ready_and_goes_on_telling_that_it_lives(systemd: socket.socket, tmp_path: Path) -> None:
    """A start would never end; or the watchdog would kill a ground that works, every 30 s; or it would not stop."""
    with Link(tmp_path, name="alone") as link:
        ground = link.ground("--detector", "motion", "--classifier", "none")
        assert systemd.recv(64) == b"READY=1"
        assert [systemd.recv(64) for _ in range(3)] == [b"WATCHDOG=1"] * 3
        ground.stop(signal.SIGTERM)
        assert ground.finish() == []
        assert "no picture of an edge came" in ground.told


def test_an_edge_is_ready_before_any_ground_is_there(
    systemd: socket.socket, tmp_path: Path, scene: Path
) -> None:
    """A drone that boots before its ground would hang in its start, or end by kill -9 alone."""
    with Link(tmp_path, name="alone") as link:
        edge = link.edge(
            "--source", str(scene), "--method", "M0", "--wait", "600s"
        )  # longer than for its end
        assert systemd.recv(64) == b"READY=1"
        assert [systemd.recv(64) for _ in range(3)] == [b"WATCHDOG=1"] * 3, "it waits for a ground"
        edge.stop(signal.SIGTERM)
        assert edge.finish()["frames"] == 0


def test_a_socket_that_is_gone_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A ground would end because who looks after it does not listen."""
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    notify_systemd("READY=1")
    monkeypatch.delenv("NOTIFY_SOCKET")
    notify_systemd("READY=1")
