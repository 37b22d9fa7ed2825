"""Networks that take long to load: a ground receives, records and shows video meanwhile."""

import threading
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest

from hvt_common.errors import UserError
from hvt_common.protocol.messages import RoiHeader
from hvt_common.runtime.failures import Failures
from hvt_ground import app
from hvt_ground.app import Ground
from hvt_ground.backlog.session_backlog import read_still
from hvt_ground.config import GroundConfig, check
from hvt_ground.extras import Service
from hvt_ground.perception import models as ground_models
from hvt_ground.perception.models import NotOpenError
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.report.state import StateMaker
from hvt_ground.report.status import completed, status_text, summary, table
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import Session
from hvt_ground.sinks import Outputs
from hvt_ground.wiring import Models, SessionFactory
from programs.processes import eventually
from programs.rrd import Recording
from rigs.flight import Flight, Port, RedSquares

FRAMES = 6


class Compiler:
    """A runtime that loads until it is `done`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done = threading.Event()
        self.error: Exception | None = None
        monkeypatch.setattr(ground_models, "open_detector", self.open)

    def open(self, *_: object, **__: object) -> RedSquares:
        self.done.wait(60)
        if self.error is not None:
            raise self.error
        return RedSquares()


@pytest.fixture
def compiler(monkeypatch: pytest.MonkeyPatch):
    compiler = Compiler(monkeypatch)
    yield compiler
    compiler.done.set()


def listening(port: int) -> GroundConfig:
    return check(GroundConfig(listen=(f"tcp/127.0.0.1:{port}",), classifier="none", quiet=True))


def nothing(_info: object):
    """A program that takes nothing, in place of a recording."""
    parts = {"path": None, "awaits_keyframe": False, "log": lambda _: None, "close": lambda _=None: None}
    return lambda: SimpleNamespace(**parts)


class Loading:
    """A ground of one edge, of which no detector is open yet."""

    def __init__(self, flight: Flight, config: GroundConfig, **parts: Any) -> None:
        self.outputs, self.models = Outputs(Failures(time.time_ns)), Models(check(config))
        self.factory = SessionFactory(
            check(config), self.models, clock=time.time_ns, outputs=self.outputs, **parts
        )
        self.ended: list[Session] = []
        port = Port()
        port.flight = flight
        self.sessions = EdgeSessions(port, open_session=self.factory.open_session, on_ended=self.ended.append)

    def close(self) -> None:
        self.sessions.close()
        self.outputs.close()


def test_video_is_recorded_while_the_detector_loads_and_boxes_come_with_it(compiler, tmp_path: Path) -> None:
    """A viewer on a busy machine saw nothing for 40 s, and nothing of them was recorded."""
    flight = Flight(FRAMES)
    ground = Loading(flight, GroundConfig(classifier="none", record=tmp_path / "a.rrd"))
    models, sessions = ground.models, ground.sessions
    maker = StateMaker(time.time_ns, loading=lambda: models.loading)
    for index in range(FRAMES - 1):
        sessions.handle(flight.base(index))
    state = maker.make([("uav-1", sessions)])
    assert state.edges[0].session.frames_decoded == FRAMES - 1
    assert state.edges[0].session.tracks == 0
    assert status_text(state).endswith("detector loading")
    compiler.done.set()
    eventually(lambda: not models.loading, what="loaded")
    sessions.handle(flight.base(FRAMES - 1))
    eventually(lambda: sessions.session.perceived.tracks == 1, what="a box")
    assert "loading" not in status_text(maker.make([("uav-1", sessions)]))
    ground.close()
    assert summary(ground.ended[0])["tracks"] == 1
    assert len(Recording(tmp_path / "a.rrd").video()) == FRAMES


@pytest.mark.parametrize("fails_before", [None, 0, 2], ids=["stopped", "no detector", "none after all"])
def test_a_run_that_ends_while_the_detector_loads_still_tells_of_its_flight(
    compiler, fails_before: int | None
) -> None:
    """Whoever stopped a ground in lockstep read that no edge was heard, and waited for the detector to learn it.

    And where the detector was none, that all else goes on, a line before the end.
    """
    flight = Flight(2, pace="lockstep")
    ground = Loading(flight, GroundConfig(classifier="none"), program=nothing)
    models, sessions = ground.models, ground.sessions
    for index in range(3):
        if index == fails_before:
            compiler.error = UserError("d.onnx is not a detector")
            compiler.done.set()
            eventually(lambda: models.error is not None, what="it is known")
        if index < 2:
            sessions.handle(flight.base(index))
    models.give_up()
    closing = threading.Thread(target=sessions.close, daemon=True)
    closing.start()
    closing.join(60)
    assert not closing.is_alive()
    content = summary(ground.ended[0])
    assert (content["frames_decoded"], content["failure"]) == (2, "")
    told = completed(content, sessions)
    assert told["failed"] == []
    assert dict(table(told))["tracks"] == "not known: the detector has looked at no picture"
    ground.outputs.close()


def test_a_stored_still_that_nobody_read_before_the_run_ended_comes_again(compiler) -> None:
    """The edge would take it for recorded, and forget it."""
    flight, done = Flight(2), list[bool | None]()
    ground = Loading(flight, GroundConfig(classifier="none"), program=nothing)
    ground.sessions.handle(flight.base(0))
    item = flight.still(0, 0)
    still = ReceivedStill(RoiHeader.parse(item.attachment, item.payload), item.payload)
    backlog = ground.sessions.session.backlog
    job = read_still(still, lambda: nullcontext(backlog), done=done.append)
    ground.models.give_up()
    with pytest.raises(NotOpenError):
        next(job)
    assert done == [None]
    assert backlog.is_new_still(still.header.sequence)
    ground.sessions.close()


def test_the_link_is_open_before_the_detector(compiler, free_port: int, monkeypatch) -> None:
    """An edge would find nobody, and fly its first minute for no one."""
    stop = threading.Event()
    config = listening(free_port)
    made: list[Models] = []
    monkeypatch.setattr(
        app, "Models", lambda config, **clock: made.append(Models(config, **clock)) or made[-1]
    )
    assert Ground(config, stop=stop, on_started=stop.set).run() == []
    with pytest.raises(NotOpenError, match="the run ends before"):
        made[0].take()


def test_a_detector_that_is_none_after_all_ends_the_run_with_its_sentence(compiler, free_port: int) -> None:
    """The ground would go on for hours without a box."""
    compiler.error = UserError("d.onnx is not a detector")
    config = listening(free_port)
    with pytest.raises(UserError, match=r"d\.onnx is not a detector"):
        Ground(config, stop=threading.Event(), on_started=compiler.done.set).run()


class Broken(Service):
    """An extra's service, of which each call raises."""

    def sinks(self, *_: object) -> NoReturn:
        raise RuntimeError("broken")

    recorded = still_address = sinks


def test_an_extra_that_raises_takes_no_session_and_no_recording_with_it(tmp_path: Path) -> None:
    """No picture of any edge was recorded, for a session with it could not be opened."""
    flight = Flight(2)
    config = GroundConfig(detector="motion", classifier="none", record=tmp_path / "a.rrd")
    ground = Loading(flight, config, services=[Broken()])
    for index in range(2):
        ground.sessions.handle(flight.base(index))
    ground.close()
    assert len(Recording(tmp_path / "a.rrd").video()) == 2
    assert [one.reason for one in ground.models.failures.parts] == ["RuntimeError: broken"]
    assert ground.outputs.idle
