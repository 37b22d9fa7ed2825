"""Which edges a ground serves where more names come than it takes; how it talks to them, and hands over errors."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import InfoRequest
from hvt_common.transport.inbox import Received
from hvt_common.transport.session import open_session, serve
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.units import SECOND_NS
from hvt_common.video.still_codecs import still_codec_names
from hvt_ground.session.edge_port import EdgePort
from hvt_ground.session.subscribe import MAX_EDGES, GroundLink
from programs.outsider import Tap, joined
from programs.processes import eventually
from rigs.messages import FEEDBACK, INFO


@contextmanager
def ground_of(edges: str, port: int, **named) -> Iterator[tuple[GroundLink, zenoh.Session]]:
    """A ground that asks for these edges, and somebody else who is joined to it."""
    endpoint = f"tcp/127.0.0.1:{port}"
    with (
        open_session(LinkSettings("ground", listen=(endpoint,))) as session,
        GroundLink(session, edges=edges, **named) as link,
        joined(endpoint) as outsider,
    ):
        yield link, outsider


@pytest.fixture
def link(free_port: int) -> Iterator[tuple[GroundLink, zenoh.Session]]:
    with ground_of("*", free_port) as both:
        yield both


def say(outsider: zenoh.Session, edge: str, channel: str = "base") -> None:
    outsider.put(f"hvt/{edge}/{channel}", b"x", congestion_control=zenoh.CongestionControl.BLOCK)


def show(outsider: zenoh.Session, *edges: str) -> list[zenoh.LivelinessToken]:
    return [outsider.liveliness().declare_token(f"hvt/{edge}/alive") for edge in edges]


def served(link: GroundLink) -> dict[str, EdgePort]:
    return {port.edge: port for port in link.ports()}


def test_an_edge_that_was_not_asked_for_is_not_served(free_port):
    """A shared link would carry the streams of everybody to everybody."""
    with ground_of("uav-*", free_port) as (ground, outsider):
        for edge in ("rover-1", "uav-1"):
            say(outsider, edge)
        eventually(lambda: served(ground), what="one is served")
        assert served(ground).keys() == {"uav-1"}


def test_invented_names_do_not_lock_out_a_real_edge(link, caplog):
    """Somebody says 64 names, and the drone that starts afterwards is never shown, without a word."""
    ground, outsider = link
    for number in range(MAX_EDGES + 6):
        say(outsider, f"ghost-{number}")
    eventually(lambda: ground.foreign == 6, what="all names have come")
    assert len(served(ground)) == MAX_EDGES
    lines = [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING]
    (line,) = lines
    assert line == (
        f"ghost-{MAX_EDGES} is not served: there are {MAX_EDGES} edge ids already, and more are not taken; narrow "
        "--edges, or see who invents names (docs/security.md has keys against that)"
    )
    first = ground.ports()[0]
    with outsider.liveliness().declare_token("hvt/uav-1/alive"):
        eventually(lambda: "uav-1" in served(ground), what="the real one is served")
        assert len(served(ground)) == MAX_EDGES
        assert first.edge not in served(ground)
        assert first.inbox.get(timeout_s=0.1) is not None, "what had come is still there"
        assert ground.is_known("uav-1")


def test_tokens_alone_do_not_keep_out_an_edge_that_sends(link):
    """Somebody shows a thousand tokens, and the drone that starts afterwards is never shown."""
    ground, outsider = link
    assert not ground.is_known(""), "nobody is there"
    count = 2 * MAX_EDGES + 2
    tokens = show(outsider, *(f"ghost-{number}" for number in range(count)))
    with outsider.liveliness().declare_token("hvt/uav-1/alive"):
        eventually(lambda: ground.is_known("uav-1") and ground.is_known(""), what="its token has come")
        assert "uav-1" not in served(ground)
        say(outsider, "uav-1", "status")
        eventually(lambda: "uav-1" in served(ground), what="it is served")
        port = served(ground)["uav-1"]
        assert port.present.is_set()
        assert port.inbox.get(timeout_s=0.1) is not None
        say(outsider, "ghost-0", "status")
        assert len(served(ground)) == MAX_EDGES
    for token in tokens:
        token.undeclare()


def test_edges_that_are_there_or_fly_keep_their_place(link):
    """A stranger's token would end a flight."""
    ground, outsider = link
    tokens = show(outsider, *(f"real-{number}" for number in range(MAX_EDGES - 1)))
    eventually(lambda: len(served(ground)) == MAX_EDGES - 1, what="all are seen")
    say(outsider, "ghost-0")
    eventually(lambda: "ghost-0" in served(ground), what="one more")
    ghost = served(ground)["ghost-0"]
    ghost.used.set()
    with outsider.liveliness().declare_token("hvt/late/alive"):
        eventually(lambda: ground.foreign == 1, what="it is refused")
        assert "late" not in served(ground)
        ghost.used.clear()
        say(outsider, "late", "base")
        eventually(lambda: "late" in served(ground), what="a flight has ended, so there is a place")
        assert served(ground)["late"].present.is_set()
    for token in tokens:
        token.undeclare()


def test_answers_that_are_none_do_not_fill_the_log(monkeypatch, caplog):
    """Somebody who answers to info in an edge's name, a thousand times to each question, would fill the disk."""

    def query_later(*_, on_answer, on_end, **__):
        for _ in range(1000):
            on_answer(b"nothing")
        on_end()

    monkeypatch.setattr("hvt_ground.session.edge_port.query_later", query_later)
    port = EdgePort(None, "uav-1", clock=time.time_ns)  # type: ignore[arg-type]
    assert port.query_info(7) is None
    assert [record.args[1] for record in caplog.records] == [2**power for power in range(10)]


def test_a_ground_says_which_stills_it_reads(link):
    """The edge would send what nobody here can show."""
    ground, outsider = link
    keys, questions = EdgeKeys("uav-1"), []
    queryable = serve(
        outsider, Channel.INFO, keys=keys, answer=lambda question: questions.append(question) or INFO.pack()
    )
    with outsider.liveliness().declare_token(keys[Channel.ALIVE]):
        eventually(lambda: served(ground), what="it is served")
        (port,) = ground.ports()
        for count in (1, 2):
            port.query_info(7)
            eventually(lambda count=count: len(questions) == count, what="it has asked")
        queryable.undeclare()
    first, second = map(InfoRequest.parse, questions)
    assert first == second
    assert {"jpeg", "h264-intra", "residual"} <= set(first.still_codecs) <= set(still_codec_names())


def test_an_error_in_a_callback_reaches_the_edges_thread(free_port: int, capfd) -> None:
    """Zenoh would print a traceback for every message, and nobody would learn that nothing comes in any more."""
    broken, errors = threading.Event(), list[str]()

    def clock() -> int:
        if broken.is_set():
            raise RuntimeError("the clock is gone")
        return time.time_ns()

    with ground_of("*", free_port, clock=clock) as (ground, outsider):
        for edge in ("uav-1", "uav-2"):
            say(outsider, edge)
        eventually(lambda: len(served(ground)) == 2, what="both are served")
        one, other = sorted(ground.ports(), key=lambda port: port.edge)
        broken.set()
        say(outsider, "uav-1")

        def failed() -> bool:
            try:
                one.raise_error()
            except RuntimeError as error:
                errors.append(str(error))
            return bool(errors)

        eventually(failed, what="the error is handed over")
        assert errors == ["the clock is gone"]
        one.raise_error()  # once
        other.raise_error()
    assert "Traceback" not in capfd.readouterr().err


class Declarations:
    """A session that notes in which thread publishers are declared."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self.threads: list[str] = []

    def declare_publisher(self, *arguments, **named):
        self.threads.append(threading.current_thread().name)
        return self._session.declare_publisher(*arguments, **named)

    def __getattr__(self, name: str):
        return getattr(self._session, name)


def test_nothing_is_declared_in_a_callback(free_port: int) -> None:
    """Zenoh may wait there for itself: the ground would stand still with the first message of a second edge."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(LinkSettings("ground", listen=(endpoint,))) as session, joined(endpoint) as outsider:
        declarations = Declarations(session)
        with (
            GroundLink(declarations, edges="*") as ground,  # type: ignore[arg-type]
            outsider.liveliness().declare_token("hvt/uav-1/alive"),
        ):
            eventually(lambda: "uav-1" in served(ground), what="it is served")
            assert declarations.threads == []
            tap = Tap(outsider, "hvt/uav-1/feedback")

            def reported() -> bool:
                ground.ports()[0].report(FEEDBACK)
                return bool(tap.messages)

            eventually(reported, what="the edge gets reports all the same")
            assert declarations.threads == [threading.current_thread().name]


def test_who_reports_without_end_is_heard_a_hundred_times_a_second():
    """Each report is a turn of all sinks: 1,500 a second in one edge's name took half of what others were shown."""
    port = EdgePort(None, "uav-1", clock=time.time_ns)  # type: ignore[arg-type]
    heard = {Channel.STATUS: 0, Channel.BASE: 0}
    for number in range(1500):
        for row in heard:
            port.put(Received(f"hvt/uav-1/{row}", b"", b"", "", number * SECOND_NS // 1500), row)
            heard[row] += port.inbox.get(timeout_s=0) is not None
    assert heard == {Channel.STATUS: pytest.approx(200, abs=2), Channel.BASE: 1500}, "after a hundred at once"


def test_an_edge_that_is_left_while_a_report_goes_out(free_port: int) -> None:
    """Zenoh forbids what two threads do at once: a ground of a group ended when an edge moved to another."""
    endpoint, reporting = f"tcp/127.0.0.1:{free_port}", threading.Event()

    def report(port: EdgePort) -> None:
        for _ in range(2000):
            port.report(FEEDBACK)
            reporting.set()

    with open_session(LinkSettings("ground", listen=(endpoint,))) as session, joined(endpoint) as outsider:
        tap = Tap(outsider, "hvt/uav-1/feedback")
        for _ in range(20):
            reporting.clear()
            left = EdgePort(session, "uav-1", clock=time.time_ns)
            worker = threading.Thread(target=report, args=(left,))
            worker.start()
            assert reporting.wait(60)
            left.close()
            worker.join()
        next_port = EdgePort(session, "uav-2", clock=time.time_ns)
        other = Tap(outsider, "hvt/uav-2/feedback")

        def reported() -> bool:
            next_port.report(FEEDBACK)
            return bool(other.messages)

        eventually(reported, what="another edge gets reports all the same")
        count = len(tap.messages)
        left.report(FEEDBACK)
        next_port.report(FEEDBACK)
        time.sleep(0.3)
        assert 0 < len(tap.messages) == count, "after its end a port says nothing"
        next_port.inbox.close()
        count = len(other.messages)
        next_port.report(FEEDBACK)
        eventually(lambda: len(other.messages) > count, what="a ground that stops says its last")


def test_silent_edges_hold_up_nobody(free_port: int) -> None:
    """With eight edges that do not answer, each round of asking for their time would take eight seconds."""
    asked: list[zenoh.Query] = []
    with ground_of("*", free_port) as (ground, outsider):
        queryables = [outsider.declare_queryable(f"hvt/uav-{one}/info", asked.append) for one in range(8)]
        tokens = show(outsider, *(f"uav-{one}" for one in range(8)))
        eventually(lambda: len(served(ground)) == 8, what="all are seen")
        for port in ground.ports():
            port.request_info(INFO.session_id)
        eventually(lambda: len(asked) == 8, what="all are asked")
        ports = served(ground)
        assert all(port.take_info() is None for port in ports.values())

        def answered() -> bool:
            """An answer that a busy machine gives too late is none: it asks again."""
            ports["uav-3"].request_info(INFO.session_id)
            late = next(one for one in reversed(asked) if str(one.key_expr) == "hvt/uav-3/info")
            late.reply("hvt/uav-3/info", replace(INFO, edge="uav-3").pack())
            answer = ports["uav-3"].take_info()
            return answer is not None and answer[0].edge == "uav-3"

        eventually(answered, what="the answer is there when it comes")
        for one in asked:
            one.drop()
        for one in (*queryables, *tokens):
            one.undeclare()


def test_an_edge_that_a_lost_subscription_keeps_silent_is_subscribed_to_again() -> None:
    """One datagram that UDP loses held all subscriptions: the edge was there and never sent a picture."""
    session, now_s, declared, gone = MagicMock(), [1000], {}, []

    def declare(key: str, callback: Callable[[object], None]) -> MagicMock:
        declared[key] = callback
        return MagicMock(undeclare=lambda: gone.append(key))

    def came(key: str, *, channel: str = "status") -> None:
        said = {
            "kind": zenoh.SampleKind.PUT,
            "key_expr": f"hvt/uav-1/{channel}",
            "attachment": None,
            "encoding": "",
        }
        declared[key](SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: b"x"), **said))

    session.declare_subscriber.side_effect = declare
    link = GroundLink(session, edges="*", clock=lambda: now_s[0] * SECOND_NS, loses=lambda: True)
    general = list(declared)
    session.liveliness().declare_subscriber.call_args.args[1](
        SimpleNamespace(kind=zenoh.SampleKind.PUT, key_expr="hvt/uav-1/alive")
    )
    made = []
    for _ in range(16):
        now_s[0] += 1
        (port,) = link.ports()
        made.append(len(declared))
    assert made == [6] * 2 + [12] * 4 + [18] * 8 + [24] * 2, "after 2, 4 and 8 s"
    own = [one for one in declared if one not in general]
    assert gone == own[:6], "the edge may know no others than those before the last"

    def met_by(key: str) -> Channel:
        (met,) = [one for one in Channel if zenoh.KeyExpr(key).intersects(EdgeKeys("uav-1")[one])]
        assert not zenoh.KeyExpr(key).intersects(EdgeKeys("uav-2")[met])
        return met

    rows = list(map(met_by, own[:6]))
    now_s[0] += 100
    for key in ("hvt/*/status", *(one for one in own if one.startswith("hvt/uav-1/s"))):
        came(key)
    assert port.inbox.get(timeout_s=0) is not None
    assert port.inbox.get(timeout_s=0) is None, "it comes by several subscriptions, and is one message"
    link.ports()
    assert {met_by(one) for one in list(declared)[24:]} == {*rows} - {Channel.STATUS}, "each may go alone"
    for row in rows:
        came(next(one for one in reversed(declared) if met_by(one) is row), channel=row)
    now_s[0] += 1
    link.ports()
    assert session.declare_subscriber.call_count == 29, "all are heard"
    port.present.clear()
    link.ports()
    port.present.set()
    for _ in range(3):
        now_s[0] += 1
        link.ports()
    assert session.declare_subscriber.call_count == 35, "on another way"


class Shared:
    """A group whose edges are all this member's, but those that are ``elsewhere``."""

    def __init__(self) -> None:
        self.elsewhere: set[str] = set()

    def serves(self, edge: str) -> bool:
        return edge not in self.elsewhere

    def release(self, edge: str) -> None:
        """Another may have it."""

    def forget(self, *, except_for: set[str]) -> None:
        """Others are gone."""


@pytest.mark.parametrize("moves", [False, True])
def test_in_a_group_an_edge_that_made_space_may_come_back_or_move(free_port: int, moves: bool) -> None:  # noqa: FBT001
    """The member, and with it the video of 63 others, ended with a KeyError."""
    group = Shared()
    with ground_of("*", free_port, group=group) as (link, outsider):
        tokens = show(outsider, *(f"uav-{number}" for number in range(MAX_EDGES)))
        eventually(lambda: len(link.ports()) == MAX_EDGES, what="all are served")
        first = served(link)["uav-0"]
        tokens[0].undeclare()  # type: ignore[no-untyped-call]
        eventually(lambda: not first.present.is_set(), what="it is gone, without a picture")
        tokens += show(outsider, "new")
        eventually(lambda: "new" in served(link), what="it has made space")
        assert len(link.ports()) == MAX_EDGES
        link.closed(first)
        group.elsewhere |= {"uav-0"} if moves else {"uav-1"}
        tokens += show(outsider, "uav-0")
        eventually(lambda: link.is_known("uav-0"), what="it is back")
        eventually(lambda: ("uav-0" in served(link)) is not moves, what="it is where it belongs")
        assert len(link.ports()) == MAX_EDGES
