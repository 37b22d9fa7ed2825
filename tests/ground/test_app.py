"""One run of a ground: when it ends by itself, and what it says where it cannot go on."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hvt_common.errors import FlightError, UserError
from hvt_common.protocol.channels import GroupKeys
from hvt_common.transport.session import open_session
from hvt_ground import app
from hvt_ground.app import Ground
from hvt_ground.config import GroundConfig, check
from hvt_ground.extras import Extra, Service
from hvt_ground.perception import models
from hvt_ground.session import edge_sessions
from hvt_ground.session.edge_sessions import EdgeSessions
from programs.outsider import joined
from programs.processes import eventually

ALIVE = "hvt/uav-1/alive"


def config(port: int, folder: Path | None, **changes: Any) -> GroundConfig:
    light = {"detector": "motion", "classifier": "none", "quiet": True}
    return check(GroundConfig(listen=(f"tcp/127.0.0.1:{port}",), record=folder, **light, **changes))


class Run:
    """A ground in a thread of its own."""

    def __init__(self, settings: GroundConfig, **more: Any) -> None:
        self.started, self.stop = threading.Event(), threading.Event()
        self.sessions: list[dict[str, Any]] | None = None
        self.error: Exception | None = None
        self.ground = Ground(settings, stop=self.stop, on_started=self.started.set, **more)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self.started.wait(60)

    def _run(self) -> None:
        try:
            self.sessions = self.ground.run()
        except (FlightError, UserError) as error:
            self.error = error

    @property
    def over(self) -> bool:
        return not self._thread.is_alive()

    def wait(self) -> None:
        eventually(lambda: self.over, what="the ground has ended")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The ground's, which stands still but for what a test does."""
    made = SimpleNamespace(now_s=0.0)
    made.monotonic = lambda: made.now_s
    monkeypatch.setattr(app, "time", made)
    return made


def test_once_it_ends_when_who_came_left_without_a_picture(free_port: int, tmp_path: Path, clock) -> None:
    """A script would wait for ever for an edge whose camera failed."""
    run = Run(config(free_port, tmp_path, once=True, wait=60.0))
    try:
        with joined(f"tcp/127.0.0.1:{free_port}") as outsider:
            with outsider.liveliness().declare_token(ALIVE):
                eventually(lambda: "hvt-receive-uav-1" in [one.name for one in threading.enumerate()])
                clock.now_s = 61.0
                time.sleep(0.5)
                assert not run.over, "it is there, and may yet send a picture"
            run.wait()
        assert run.sessions == []
    finally:
        run.stop.set()


def test_once_it_ends_when_nobody_comes_in_time(free_port: int, tmp_path: Path, clock) -> None:
    """A script would wait for ever for an edge that does not start; what an earlier ground recorded be destroyed."""
    (tmp_path / "f.rrd").write_text("flight")
    run = Run(config(free_port, tmp_path / "f.rrd", once=True, wait=60.0))
    clock.now_s = 59.0
    time.sleep(0.5)
    assert not run.over
    clock.now_s = 61.0
    run.wait()
    assert run.sessions == []
    assert [one.read_text() for one in tmp_path.glob("earlier-*/f.rrd")] == ["flight"]


def test_it_has_one_clock(free_port: int, tmp_path: Path, monkeypatch) -> None:
    """A clock that was set in flight was said twice, by different seconds; failures had the second one's times."""
    monkeypatch.setattr(models, "SteadyClock", None)
    run = Run(config(free_port, tmp_path))
    run.stop.set()
    run.wait()
    assert (run.sessions, run.error) == ([], None)


def test_once_without_a_time_to_wait_it_waits(free_port: int, tmp_path: Path, clock) -> None:
    """A ground that is started before its edge would be gone when that comes."""
    run = Run(config(free_port, tmp_path, once=True))
    clock.now_s = 1e6
    time.sleep(0.5)
    assert not run.over
    run.stop.set()
    run.wait()


def test_a_listener_that_hears_nothing_any_more_is_made_anew(
    free_port: int, tmp_path: Path, monkeypatch, caplog, clock
) -> None:
    """No picture would come back once the ground's radio was plugged in anew, or the ground stood still.

    It ended, too, where a file of the link's was gone or its port taken just then. With ``--once`` it
    would end before an edge can have come back, or never if none does.
    """
    there, anew = socket.if_nameindex(), "since its interface was removed: the link is made anew"
    monkeypatch.setattr(socket, "if_nameindex", lambda: there if anew in caplog.text else [])
    opened = iter((True, False, False, True))

    def opens(*given: Any, **more: Any) -> Any:
        if next(opened):
            return open_session(*given, **more)
        raise UserError("cannot read ca.pem")

    monkeypatch.setattr(app, "open_session", opens)
    listen = (f"tcp/127.0.0.1:{free_port}#iface=lo",)
    run = Run(replace(config(free_port, tmp_path, once=True, wait=20.0), listen=listen))
    try:
        eventually(lambda: "link: works again" in caplog.text)
        assert f"hears nothing any more, {anew}" in caplog.text
        said = "link: cannot read ca.pem; all else goes on, and it is tried again"
        assert caplog.messages.count(said) == caplog.messages.count("link: works again") == 1
        clock.now_s = 30.0
        time.sleep(0.5)  # it looks several times
        with joined(f"tcp/127.0.0.1:{free_port}") as outsider, outsider.liveliness().declare_token(ALIVE):
            eventually(lambda: "hvt-receive-uav-1" in [one.name for one in threading.enumerate()])
        clock.now_s = 61.0
        run.wait()
    finally:
        run.stop.set()


@pytest.mark.parametrize("once", [True, False])
def test_a_link_that_cannot_be_made_anew_keeps_no_run_from_its_end(
    free_port: int, tmp_path: Path, monkeypatch, caplog, clock, *, once: bool
) -> None:
    """``--once`` never returned; nor did a run whose models cannot be used."""
    first = iter((open_session,))

    def opens(*given: Any, **more: Any) -> Any:
        for opened in first:
            return opened(*given, **more)
        raise UserError("cannot read ca.pem")

    monkeypatch.setattr(app, "open_session", opens)
    run = Run(config(free_port, tmp_path, once=once))
    try:
        clock.now_s = 1e6  # they were there until now
        run.ground._deaf.set()  # noqa: SLF001 - as its listener says
        eventually(lambda: "link: cannot read ca.pem" in caplog.text)
        clock.now_s += 59.0
        time.sleep(1.5)  # it tries once more
        assert not run.over
        clock.now_s += 2.0
        if not once:
            monkeypatch.setattr(app.Models, "error", UserError("it is no model"))
        run.wait()
        assert str(run.error) == ("the ground cannot go on: cannot read ca.pem" if once else "it is no model")
    finally:
        run.stop.set()


class Brings(Extra):
    """An extra with one service."""

    def __init__(self, shown: str = "") -> None:
        self.service = Service()
        self.service.shown_to_others = shown

    def serve(self, *_: Any, **__: Any) -> Service:
        return self.service


@pytest.fixture
def service(monkeypatch) -> Service:
    brings = Brings()
    monkeypatch.setattr("hvt_ground.app.extras_of", lambda _config: (brings,))
    return brings.service


@pytest.mark.parametrize("program", [None, lambda _info: None])
def test_it_records_where_it_is_started_and_says_so_unless_a_program_takes_all(
    free_port: int, service, monkeypatch, program: Any
) -> None:
    """NOT RECORDED stood beside recordings; a program was refused for a folder that it leaves alone."""
    states = list[Any]()
    service.show = states.append
    monkeypatch.setattr(os, "access", lambda *_: program is None)
    run = Run(config(free_port, None), program=program)
    eventually(lambda: states, what="a state")
    run.stop.set()
    run.wait()
    assert states[0].recorded == (program is None)


def test_an_extra_that_raises_takes_nothing_with_it(free_port: int, tmp_path: Path, service) -> None:
    """A page that could not show a state ended the ground, without a summary; an index the recording."""
    states = list[Any]()

    def show(state: Any) -> None:
        states.append(state)
        raise RuntimeError("no room")

    service.show = show
    run = Run(config(free_port, tmp_path))
    eventually(lambda: states and states[-1].failed, what="it is said")
    run.stop.set()
    run.wait()
    (failed,) = states[-1].failed
    assert (failed.part, failed.reason) == ("extra hvt_ground", "RuntimeError: no room")
    assert run.sessions == []


def test_an_extra_that_hangs_holds_itself_alone(free_port: int, tmp_path: Path, service) -> None:
    """A page that did not return from a state kept the ground from new edges, and from its end."""
    shown, hung = list[Any](), threading.Event()
    service.show = lambda state: (shown.append(state), hung.wait())
    run = Run(config(free_port, tmp_path))
    try:
        eventually(lambda: shown, what="a state")
        run.stop.set()
        run.wait()
        assert len(shown) == 1, "the newest state waits for no earlier one"
    finally:
        hung.set()


def test_a_group_learns_of_the_page_whatever_else_is_served(
    free_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an index of recordings, too, an edge that another member serves would have no link to its page."""
    extras = (Brings(), Brings("https://base-a.example/"), Brings())
    monkeypatch.setattr("hvt_ground.app.extras_of", lambda _config: extras)
    run = Run(config(free_port, tmp_path, group="north"))
    try:
        with joined(f"tcp/127.0.0.1:{free_port}") as outsider:
            pages: list[bytes] = []

            def answered() -> bool:
                answers = outsider.get(GroupKeys("north").everything, timeout=5.0)
                pages[:] = [one.ok.payload.to_bytes() for one in answers if one.ok is not None]
                return bool(pages)

            eventually(answered, what="a member answers")
            assert pages == [b"https://base-a.example/"]
    finally:
        run.stop.set()


def test_a_session_that_hangs_at_the_end_is_said(
    free_port: int, tmp_path: Path, service, monkeypatch
) -> None:
    """Its flight was in no summary, and the ground ended with 0 as if all were well."""
    states, hung = list[Any](), threading.Event()
    service.show = states.append
    monkeypatch.setattr(EdgeSessions, "close", lambda _: hung.wait())
    monkeypatch.setattr(edge_sessions, "join", lambda edges: [one.stop() for one in edges])
    run = Run(config(free_port, tmp_path))
    try:
        with joined(f"tcp/127.0.0.1:{free_port}") as outsider, outsider.liveliness().declare_token(ALIVE):
            eventually(lambda: states and states[-1].edges, what="the edge is served")
            run.stop.set()
            run.wait()
    finally:
        run.stop.set()
        hung.set()
    assert isinstance(run.error, FlightError)
    assert str(run.error).startswith("it was stopped, and something in it hangs")


class Failing(threading.Event):
    """What a run is stopped by, where even that goes wrong."""

    def wait(self, timeout: float | None = None) -> bool:
        raise RuntimeError("can't start new thread")


def test_what_cannot_be_put_right_in_flight_is_one_sentence(free_port: int, tmp_path: Path) -> None:
    """A supervisor would read a traceback, and not know whether to start it again."""
    ground = Ground(config(free_port, tmp_path), stop=Failing())
    said = r"^the ground cannot go on: RuntimeError: can't start new thread$"
    with pytest.raises(FlightError, match=said) as raised:
        ground.run()
    assert raised.value.summary == [], "of no session, for none was there"


@pytest.fixture
def command(free_port: int) -> list[str]:
    """A ground that ends by itself, up to the file of its summary."""
    words = ["--listen", f"tcp/127.0.0.1:{free_port}", "--detector", "motion", "--classifier", "none"]
    return [sys.executable, "-m", "hvt_ground.cli", *words, "--once", "--wait", "1s", "--summary"]


@pytest.mark.integration
def test_a_ground_serves_on_when_nobody_reads_its_status(command: list[str], tmp_path: Path) -> None:
    """The recording would end with the terminal."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as dead:
        subprocess.run([*command, "s.json"], cwd=tmp_path, stdout=dead, stderr=dead, check=True)
    assert json.loads((tmp_path / "s.json").read_text()) == []


@pytest.mark.integration
def test_a_summary_that_cannot_be_written_any_more_is_code_1(command: list[str], tmp_path: Path) -> None:
    """A disk that filled in flight would look like a wrong setting, so that the ground is not started again."""
    command += ["/dev/full", "--quiet"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert done.stderr == "hvt-ground: /dev/full cannot be written (No space left on device)\n"
    assert done.stdout == "hvt-ground: no picture of an edge came\n", "what is known is told first"
