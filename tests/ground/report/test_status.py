"""What a ground says of its sessions while they fly and when they have ended."""

import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from http.client import HTTPConnection
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hvt_common.protocol.edge_words import STILL_WORDS, FrameAccount
from hvt_common.protocol.messages import FailedPart, Info, Status
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_fleet.health import ground_status as watch
from hvt_fleet.health.ground_metrics import metrics_text
from hvt_ground.link import receiver
from hvt_ground.report.state import GroundState, PoseState, SessionState, StateMaker
from hvt_ground.report.status import completed, status_text, summary, table
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import Session
from hvt_ground.sinks import Outputs, QueuedSink
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_web.feed import SessionFeed, state_message
from hvt_web.viewers import EdgePage
from programs.processes import eventually
from programs.rrd import Recording
from programs.summary_page import unexplained
from rigs.flight import Flight, Port, pipeline_of


class Ground:
    """One edge at a ground, in this thread, with a recording and one that cannot be made."""

    def __init__(self, folder: Path, flight: Flight, clock: Callable[[], int] = time.time_ns) -> None:
        self.port, self.path = Port(), folder / "a.rrd"
        self.port.flight = flight
        self.failures = Failures(clock)
        self.clock = clock
        self.maker = StateMaker(clock, failures=self.failures)
        self.outputs = self.maker.outputs = Outputs(self.failures)
        self.opened: list[Session] = []
        self.ended: list[Session] = []
        self.sessions = EdgeSessions(self.port, open_session=self.open_one, on_ended=self.ended.append)

    def open_one(self, info: Info, reports: ReceiverReports) -> Session:
        settings = RecorderSettings.of(info, self.path)
        gone = replace(settings, path=self.path / "no" / "folder.rrd")
        sinks = [
            self.outputs.open("recording of uav-1", lambda: Recorder(settings), for_backlog=True),
            self.outputs.open("second recording of uav-1", lambda: Recorder(gone)),
            self.outputs.open("recording of uav-10", lambda: Recorder(gone)),
        ]
        self.opened.append(
            Session(info, sinks=sinks, pipeline_of=pipeline_of, clock=self.clock, reports=reports)
        )
        return self.opened[-1]

    def state(self) -> GroundState:
        return self.maker.make([("uav-1", self.sessions)])

    def line(self) -> str:
        return status_text(self.state())

    def metrics(self) -> str:
        return metrics_text(self.state()).decode()

    def report(self, change: Callable[[Status], Status]) -> None:
        item = self.port.flight.status(base=5)
        report = change(Status.parse(item.payload))
        self.sessions.handle(replace(item, payload=report.pack()))

    def end(self) -> dict[str, Any]:
        self.sessions.close()
        self.outputs.close()
        return summary(self.ended[0])


class Shown:
    """A hub that keeps the capture time of the newest event."""

    captured_ms = 0.0

    def post(self, call: Callable[[], None]) -> None:
        call()

    def begin(self, *_: object) -> None:
        """A session begins."""

    def notice(self, _: EdgePage, message: str) -> None:
        self.captured_ms = json.loads(message)["captured"]

    def overlay(self, *_: object) -> None:
        """On a busy machine boxes come before the end."""


@pytest.fixture
def ground(tmp_path: Path) -> Iterator[Ground]:
    """After five frames and a report of the edge."""
    flight = Flight(8)
    ground = Ground(tmp_path, flight)
    for index in range(5):
        ground.sessions.handle(flight.base(index))
    counts = {"deferred": {"cooldown": 3}, "dropped": {"base_good": 49, "too_large": 1}}
    ground.report(lambda status: replace(status, **counts))
    eventually(lambda: ground.opened[0].idle, what="the pictures are searched")
    yield ground
    if not ground.ended:
        ground.end()


def test_the_page_reads_all_of_it_as_sentences(ground):
    """``base_good 49`` and ``stills paused: 0 of 40`` say nothing to who flies."""
    state = ground.state()
    (edge,) = state.edges
    every = dict.fromkeys(STILL_WORDS, 2)
    decisions = "tracks: the video hides 31 objects; stills paused: they name 0 of 40 otherwise"
    says = {"still_outcomes": every, "stills_not_sent": every, "decisions": decisions}
    session = replace(edge.session, **says, gaps=2, lost=3)
    state = replace(state, edges=(replace(edge, session=session),), failed=ground.failures.now)
    shown = json.loads(state_message(state))["edges"]["uav-1"]
    code = re.compile("|".join(word for word in STILL_WORDS if "_" in word))
    assert not code.search(json.dumps([shown[one] for one in ("words", "why", "short", "failed")]))
    assert all(re.fullmatch(r"[A-Z].*[^.]\.", one) for one in shown["why"]), shown["why"]
    assert shown["why"][-2:] == [
        "The edge sends its tracks: the video hides 31 objects.",
        "Stills are paused: they name 0 of 40 otherwise.",
    ]


def test_who_gets_no_stills_reads_why(ground):
    """49 stills that the base made needless looked like a fault of the link."""
    assert "stills 0 (not sent: 49 the video already shows well, 3 sent a moment ago)" in ground.line()
    content = ground.end()
    assert content["stills"]["reasons"]["not_sent"] == {"base_good": 49, "cooldown": 3, "too_large": 1}
    said = "49 the video already shows well, 3 sent a moment ago, 1 too large for the budget"
    assert said in dict(table(content))["stills"]
    met = dict(table(content | {"tracks": 3, "tracks_refined": 1, "class_changes": 2}))["tracks"]
    assert met == "3; stills met 1 of them and changed the ground's own class 2 times"
    events = [text for _, _, text in Recording(ground.path).events()]
    assert f"the edge did not send these stills: {said}" in events


def test_a_recording_that_is_behind_is_told_on_line_and_page(ground, monkeypatch):
    """The log alone told that a kill would lose half a minute of it."""
    monkeypatch.setattr(QueuedSink, "behind_s", 37.4)
    state = ground.state()
    told = ["recording of uav-1 is behind by 37 s", "recording of uav-10 is behind by 37 s"]
    assert f" | {' | '.join(told)} | " in status_text(state)
    assert json.loads(state_message(state))["failed"][:2] == told
    ground.sessions.close()
    assert told[1] in ground.line(), "the session has ended, its output not"
    monkeypatch.setattr(QueuedSink, "behind_s", 1.0)
    assert "behind" not in ground.line()


def test_a_view_that_the_detector_does_not_know_is_told_everywhere(ground, monkeypatch, capsys):
    """Who came later, or reads tables alone, took guesses for objects."""
    assert "UNKNOWN VIEW" not in ground.line()
    text = ground.metrics()
    assert "hvt_view_unlike{" not in text, "nobody knows yet"
    trust = ground.opened[0].pipeline.trust
    trust.mean, trust.unlike = 0.53, True
    assert "refined  UNKNOWN VIEW" in ground.line()
    state = ground.state()
    assert (state.edges[0].session.view_trust, state.edges[0].session.view_unlike) == (0.53, True)
    shown = json.loads(state_message(state))["edges"]["uav-1"]
    assert any(one.startswith("this view is unlike") for one in shown["words"])
    text = metrics_text(state).decode()
    assert 'hvt_view_trust_ratio{edge="uav-1"} 0.53' in text
    assert 'hvt_view_unlike{edge="uav-1"} 1.0' in text
    (edge,) = state.edges
    placed = replace(edge.session, pose=PoseState(48.1, 11.5, 120.0, age_s=0.4))
    state = replace(state, loading=True, edges=(replace(edge, session=placed),))
    assert 'hvt_pose_latitude_degrees{edge="uav-1"} 48.1' in metrics_text(state).decode()
    said = json.dumps(state.as_dict()).encode()
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setattr(HTTPConnection, "request", lambda *_: None)
    answer = SimpleNamespace(status=200, read=lambda _most: said)
    monkeypatch.setattr(HTTPConnection, "getresponse", lambda _: answer)
    assert watch.run([]) == 0
    shown = capsys.readouterr().out
    assert "0 refined, UNKNOWN VIEW" in shown
    assert "uav-1 is at 48.10000, 11.50000" in shown
    assert "detector loading" in shown
    content = ground.end()
    assert (content["view_trust"], content["view_unlike"]) == (0.53, True)
    assert dict(table(content))["view"] == "unlike what the detector knows (trust 0.53)"


def test_a_link_that_carries_nothing_is_lost_in_the_line(ground, monkeypatch):
    """It said "244 kbps … 53 ms" throughout an outage."""
    now_ns = [time.monotonic_ns()]
    monkeypatch.setattr(receiver, "time", SimpleNamespace(monotonic_ns=lambda: now_ns[0]))
    ground.sessions.handle(ground.port.flight.base(5))
    assert " kbps of " in ground.line()
    now_ns[0] += 3 * SECOND_NS + SECOND_NS // 5
    line = ground.line()
    assert "LINK LOST for 3 s" in line
    assert "kbps" not in line
    ground.sessions.handle(ground.port.flight.base(6))
    assert "LINK LOST" not in ground.line()
    ground.end()


def test_a_camera_whose_clock_is_wrong_is_as_old_as_its_arrival(tmp_path):
    """``NO PICTURE for 5704667 s`` stood beside a picture of this moment."""
    flight, now_ns = Flight(6), [time.time_ns()]
    ground = Ground(tmp_path, flight, clock=lambda: now_ns[0])
    for index in range(5):
        now_ns[0] += SECOND_NS // 15
        ground.sessions.handle(replace(flight.base(index), received_ns=now_ns[0]))
    traffic = ground.sessions.session.reception.traffic(now_ns[0])
    assert (traffic.receive_latency_ms, traffic.overlay_latency_ms) == (None, None), "a recording plots them"
    now_ns[0] += 4 * SECOND_NS
    (edge,) = ground.state().edges
    assert edge.session.picture_age_s == pytest.approx(4.0, abs=0.2)
    assert edge.session.delay_p50_ms is None
    shown = Shown()
    sinks = ground.sessions.session.sinks
    assert isinstance(sinks, list)
    sinks.append(SessionFeed(flight.info(), EdgePage("uav-1"), shown, clock=ground.clock))
    ground.sessions.handle(replace(flight.base(5), received_ns=now_ns[0]))
    ground.sessions.session.note("info", "a line")
    came_ms = (now_ns[0] - 4 * SECOND_NS + SECOND_NS // 15) / 1e6  # it waited behind the hole
    assert shown.captured_ms == pytest.approx(came_ms, abs=5)
    content = ground.end()
    assert content["frames_decoded"] == 6
    assert content["latency_ms"]["p50"] is None
    assert "latency" not in dict(table(content)), "it said ``capture to overlay: p50 12 ms``"
    assert content["receive_latency_ms"]["p50"] is None
    said = [text for _, _, text in Recording(ground.path).events()]
    assert sum("the camera's clock is" in one and "s off" in one for one in said) == 1


def test_what_could_not_be_written_is_named_of_the_edge_it_concerns(ground):
    """Whoever looks for a recording after the flight would learn only then that there is none, and never why."""
    eventually(lambda: "second recording of uav-1 FAILED at " in ground.line(), what="it failed")
    content = ground.end()
    sinks = ground.ended[0].sinks
    for one in sinks:
        one.files *= 2  # removed in flight, it began anew under its name
        one.files.insert(0, ground.path.with_name("removed-by-retention.rrd"))
    content = completed(content, ground.sessions, sinks=sinks, failures=ground.failures)
    assert content["recordings"] == [str(ground.path)], "it named files that nobody would find"
    assert content["recording_bytes"] == ground.path.stat().st_size
    (failed,) = content["failed"]
    assert (failed["part"], failed["working"]) == ("second recording of uav-1", False)
    assert "does not exist" in failed["reason"]
    assert content["missing_events"].keys() == {"second recording of uav-1", "recording of uav-10"}
    assert unexplained(content) == set(), "who reads the JSON would look them up in the source"
    rows = [text for name, text in table(content) if name in ("failed", "missing")]
    assert any("second recording of uav-1" in row and "did not work again" in row for row in rows)
    assert any("events in second recording of uav-1" in row for row in rows)
    ground.path.unlink()
    content = completed(summary(ground.ended[0]), ground.sessions, sinks=sinks)
    row = dict(table(content))["recording"]
    assert row.endswith(f"{ground.path}, not there any more"), "it said 0.00 MB"
    absurd = Failures(lambda: 2**90)
    absurd.failed("timing table", "gone")
    failed = completed(summary(ground.ended[0]), ground.sessions, failures=absurd)["failed"]
    assert [(one["part"], one["since"], one["last"]) for one in failed] == [("timing table", "", "")]
    assert status_text(StateMaker(time.time_ns, failures=absurd).make([])) == "timing table FAILED at ? UTC"


def test_the_state_says_what_is_known_and_nothing_else(ground):
    """A page would show 0 bps for an edge that it has not heard, and a delay from before the outage."""
    now_ns = [time.time_ns()]
    maker = StateMaker(lambda: now_ns[0], detector="d", failures=ground.failures)
    (edge,) = maker.make([("uav-1", ground.sessions)]).edges
    assert (edge.link, edge.session.frames_received, edge.session.tracks_refined) == ("up", 5, 0)
    assert edge.session.stills_not_sent == {"base_good": 49, "cooldown": 3, "too_large": 1}
    assert edge.session.edge_frames_dropped == 0
    assert edge.session.pose is None
    since_ns = edge.link_since_ns
    now_ns[0] += 10**9
    assert maker.make([("uav-1", ground.sessions)]).edges[0].link_since_ns == since_ns
    nobody = EdgeSessions(Port(), open_session=ground.open_one)
    (waiting,) = maker.make([("uav-2", nobody)]).edges
    assert (waiting.link, waiting.session) == ("waiting", None)


@pytest.mark.parametrize(("landed", "said"), [(1, "uav-0: ended"), (60, "60 edges ended")])
def test_who_flies_is_told_before_those_that_have_landed(ground, landed, said):
    """The line of a ground that runs for weeks began with a list of sixty names that had ended.

    And where its budget had been lowered, it read "339 kbps of 300 kbps": the mean of the flight so far.
    """
    state = StateMaker(time.time_ns).make([("uav-9", ground.sessions)])
    session = replace(state.edges[0].session, total_bps=290_000.0, budget_bps=300_000)
    flies = replace(state.edges[0], session=session)
    state = replace(state, edges=(flies,))
    assert "  290 kbps of 300 kbps" in status_text(state)
    old = replace(session, delay_p50_ms=150.0, picture_age_s=19.4)
    late = status_text(replace(state, edges=(replace(flies, session=old),)))
    assert late.endswith("  LATE, 19 s old"), "it said 150 ms, the middle one of the flight"
    gone = (replace(flies, edge=f"uav-{number}", link="ended", session=None) for number in range(landed))
    assert status_text(replace(state, edges=(*gone, flies))) == f"{status_text(state)} | {said}"


@pytest.mark.parametrize(("state", "link"), [("running", "lost"), ("ended", "ended")])
def test_a_ground_without_a_link_tells_who_has_landed_from_whom_it_left(ground, state, link):
    """It said that flights ended, or that edges which landed long ago are lost."""
    ground.report(lambda status: replace(status, sequence=9, state=state))
    ground.end()
    assert StateMaker(time.time_ns).make([("uav-1", ground.sessions)]).edges[0].link == link


def test_an_edge_that_leaves_frames_out_is_on_a_thin_link(ground):
    """Frames that the link did not carry, the budget left out, or a slow machine missed want different remedies."""
    now_ns = [time.time_ns()]
    maker = StateMaker(lambda: now_ns[0])

    def link_after(sequence: int, **groups: int) -> str:
        counts = FrameAccount(groups).as_counts()
        ground.report(lambda status: replace(status, sequence=sequence, frames=counts))
        now_ns[0] += 10**9
        return maker.make([("uav-1", ground.sessions)]).edges[0].link

    assert link_after(100, sent=10) == "up"
    assert link_after(101, sent=11, processor=4, budget=7) == "up"
    assert link_after(102, sent=12, link=3) == "thin"
    assert [link_after(number, sent=13, link=3) for number in range(103, 108)] == ["thin"] * 4 + ["up"]


def test_a_state_can_be_written_as_json(ground):
    """Programs read it."""
    state = StateMaker(time.time_ns).make([("uav-1", ground.sessions)])
    read = json.loads(json.dumps(state.as_dict()))
    assert read["edges"][0]["session"]["method"] == ground.sessions.session.info.method
    assert read["edges"][0]["session"]["stills_not_sent"]["base_good"] == 49


def test_a_summary_is_of_the_whole_flight_not_of_its_first_second(ground):
    """After a command "1.6 Mbps, 200 % of 800 kbps" would be no hard budget, of a method that was given up."""
    session = ground.sessions.session
    for times, method in ((2, "M1"), (1, "M3")):
        changes = {"budget_bps": times * session.info.budget_bps, "method": method}
        session.reception.learn(replace(session.info, **changes))
    content = ground.end()
    assert (content["budget_bps"], content["method"]) == (2 * session.info.budget_bps, "M3")
    assert "budget_base_bps" not in content, "it follows the link, and no ground is told"


def test_a_part_of_the_edge_fails_since_it_stopped(ground):
    """A camera that is gone for a minute would be gone "since two seconds": each try is a new failure."""
    at_ns, reception = 1_790_000_000 * SECOND_NS, ground.sessions.session.reception
    for number, working in enumerate((False, False, True, False, False)):
        tried_ns = at_ns + number * SECOND_NS
        source = FailedPart(part="source", reason="gone", failures=1, failed_ns=tried_ns, working=working)
        ground.report(lambda status, n=number, one=source: replace(status, sequence=9 + n, failed=(one,)))
        if number == 1:
            assert reception.edge_failing == {"source": at_ns}
    stopped_ns = at_ns + 3 * SECOND_NS
    assert reception.edge_failing == {"source": stopped_ns}
    (edge,) = ground.state().edges
    assert edge.session.edge_failed[0].since_ns == reception.clock_offset.to_local_ns(stopped_ns)


def test_words_of_an_edge_do_not_become_series_without_end(ground):
    """Each new reason or part that a hostile edge names would stay in the database of whoever watches."""
    evil = FailedPart(part="evil", reason="x", failures=1, failed_ns=1, working=False)
    deferred = {f"evil {n}": 1 for n in range(20)} | {"base_good": 5}
    failed = (
        evil,
        replace(evil, part="evil 2"),
        replace(evil, part="encoder"),
        replace(evil, part="detector 2"),
    )
    ground.report(lambda status: replace(status, sequence=9, deferred=deferred, failed=failed))
    text = ground.metrics()
    ground.end()
    assert "evil" not in text
    for line in (
        'hvt_stills_not_sent_total{edge="uav-1",reason="other"} 20.0',
        'hvt_stills_not_sent_total{edge="uav-1",reason="base_good"} 5.0',
        'hvt_part_failed{edge="uav-1",part="other"} 1.0',
        'hvt_part_failed{edge="uav-1",part="encoder"} 1.0',
        'hvt_part_failed{edge="uav-1",part="detector 2"} 1.0',
    ):
        assert line in text


def test_what_was_is_not_said_to_be_now(tmp_path):
    """A camera that is gone has sent 300 kbps for an hour, by every table, plot and alert."""
    flight, now_ns = Flight(8), time.time_ns()
    ground = Ground(tmp_path, flight, clock=lambda: now_ns)
    for index in range(5):
        ground.sessions.handle(flight.base(index))

    def report() -> None:
        ground.report(lambda status: replace(status, health=replace(status.health, encode_ms=4.0)))

    def state() -> SessionState:
        return ground.state().edges[0].session

    report()
    first = state()
    of_now = attrgetter("total_bps", "budget_share", "base_bps", "roi_bps", "tracks_doubted")
    assert None not in (*of_now(first), first.edge_encode_ms)
    assert first.edge_detect_ms is None, "nothing was detected there: 0 is not how long it took"
    now_ns += 4 * SECOND_NS
    report()
    gone = state()
    assert {*of_now(gone), gone.delay_p50_ms, gone.delay_p95_ms} == {None}
    assert gone.edge_encode_ms == 4.0, "its report is of now"
    assert "NO PICTURE for" in ground.line()
    now_ns += 4 * SECOND_NS
    silent = state()
    assert (silent.edge_encode_ms, silent.edge_still_queue) == (None, None)
    assert silent.edge_frames_dropped is not None, "what is counted stays"
    text = ground.metrics()
    for name in ("hvt_received_bits_per_second", "hvt_edge_encode_seconds", "hvt_overlay_delay_p95_seconds"):
        assert f'{name}{{edge="uav-1"}}' not in text
    ground.end()
