"""Parts that fail: said once, counted, tried again ever more seldom."""

import time

import pytest

from hvt_common.runtime.failures import Failures, Retried, RetryPause, Turns
from hvt_common.units import SECOND_NS
from rigs.examples import Clock


def test_a_failing_part_is_said_once_and_its_return_once(caplog):
    """A full card would fill the log too; or nobody would learn that the part has stopped."""
    clock = Clock(100 * SECOND_NS)
    failures = Failures(clock)
    for _ in range(50):
        failures.failed("local copy", "card.mkv cannot be written")
        clock.now_ns += SECOND_NS
    failures.works("local copy")
    failures.works("local copy")
    assert [record.message.split(";")[0] for record in caplog.records] == [
        "local copy: card.mkv cannot be written",
        "local copy: works again",
    ]
    (part,) = failures.parts
    assert (part.count, part.working, part.failed_ns) == (50, True, 149 * SECOND_NS)


def test_a_part_that_comes_and_goes_does_not_flood_the_log(caplog):
    """A loose camera cable would write two lines a second for hours."""
    clock = Clock(100 * SECOND_NS)
    failures = Failures(clock)
    for _ in range(1_000):
        failures.failed("source", "no frame")
        failures.works("source")
        clock.now_ns += SECOND_NS
    assert len(caplog.records) <= 20
    clock.now_ns += 3600 * SECOND_NS
    before = len(caplog.records)
    failures.failed("source", "no frame")
    assert len(caplog.records) == before + 1, "after an hour without a fault it is news"


def test_the_next_of_a_part_that_has_ended_fails_anew(caplog):
    """A session's recording failed, and is over: that of the next one fails too, and nobody would be told."""
    clock = Clock(100 * SECOND_NS)
    failures = Failures(clock)
    failures.over("recording", failures.failed("recording", "no room"))
    clock.now_ns += 3600 * SECOND_NS
    failures.failed("recording", "no folder")
    assert ["no room" in caplog.messages[0], "no folder" in caplog.messages[-1]] == [True, True]
    assert [one.since_ns for one in failures.now] == [clock.now_ns]


def test_pauses_grow_to_their_limit_and_begin_anew_after_a_steady_time():
    """A broken part would be tried for ever at full speed; or one that failed at breakfast wait a minute at noon."""
    pause, now_ns, pauses = RetryPause(longest_ns=8 * SECOND_NS), 0, []
    assert pause.due(now_ns)
    for _ in range(6):
        pause.failed(now_ns)
        pauses.append(pause.pause_ns // SECOND_NS)
        assert not pause.due(now_ns + pause.pause_ns - 1)
        now_ns += pause.pause_ns
        assert pause.due(now_ns)
    assert pauses == [1, 2, 4, 8, 8, 8]
    for worked_s, then_s in ((9, 8), (11, 1), (11, 1), (9, 2)):
        pause.failed(now_ns := now_ns + worked_s * SECOND_NS)
        assert pause.pause_ns == then_s * SECOND_NS, "a camera that drops each 11 s would be dark for 8"
        now_ns += pause.pause_ns


def test_a_part_that_takes_long_to_fail_has_not_worked_meanwhile():
    """A network that its runtime compiles for twenty seconds, and then refuses, would burn a core for the flight."""
    clock, opened = Clock(100 * SECOND_NS), []

    def opening():
        opened.append(clock.now_ns)
        if len(opened) > 1:
            clock.now_ns += 20 * SECOND_NS
            raise OSError("refused")

    def failing(_part):
        raise OSError("failed")

    detector = Retried(opening, "detector", Failures(clock), clock=clock)
    while clock.now_ns < 700 * SECOND_NS:
        detector.run(failing)
        clock.now_ns += SECOND_NS
    assert 8 <= len(opened) <= 13


class Panic(BaseException):
    """As of a part in Rust, or `asyncio`'s cancellation."""


def raising(error):
    def run(_part):
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "said"), [(SystemExit(3), "SystemExit: 3"), (Panic("one\ntwo"), "Panic: one two")]
)
def test_a_part_that_exits_or_panics_fails_like_one_that_raises(error, said):
    """Such a plug-in ended the thread of perception for good, or the ground: boxes stood, and nothing was said."""
    failures = Failures(time.time_ns)
    assert Retried(lambda: None, "detector", failures).run(raising(error)) is None
    assert [one.reason for one in failures.now] == [said]
    with pytest.raises(KeyboardInterrupt):
        Retried(lambda: None, "detector", failures).run(raising(KeyboardInterrupt()))


def test_a_reason_is_one_line():
    """A library's page of text would be the status line."""
    failures = Failures(time.time_ns)
    failures.failed("stills", "stopped (line one\n  line two" + 500 * "x")
    (failed,) = failures.now
    assert (failed.reason[:27], len(failed.reason)) == ("stopped (line one line two" + "x", 300)


def test_of_parts_that_hang_in_one_another_the_inner_one_is_said():
    """A ground whose detector hangs would call its perception broken; one that writes a footer its recording."""
    clock = Clock(0)
    failures = Failures(clock)
    outer, inner = Turns("perception", failures, clock=clock), Turns("detector", failures, clock=clock)

    def failing():
        clock.now_ns += 11 * SECOND_NS
        return [one.part for one in failures.now]

    with outer:
        with inner:
            assert failing() == []
            assert failing() == ["detector"]
            assert "hangs: detector;" in failures.hanging
        for _ in range(3):
            outer.goes_on()
            assert failing() == []
        assert failing() == ["perception"]
    assert not failures.now
    assert "hangs;" in failures.hanging


def test_calls_that_each_return_are_not_taken_for_one_that_hangs():
    """A run whose disk is slow was ended after 9 s, as one that hangs: its extra was asked at both looks."""
    failures = Failures(time.time_ns)
    first, second = (failures.attempt("web page", failures.in_hand, None) for _ in range(2))
    assert [one for one, _ in (*first, *second)] == ["web page"] * 2
    assert not first & second


@pytest.mark.parametrize(
    "run",
    [
        lambda hang, failures, clock: Retried(lambda: None, "detector", failures, clock=clock).run(hang),
        lambda hang, failures, _: failures.attempt("detector", hang, None, None),  # as an extra is called
    ],
)
def test_a_part_that_hangs_is_said_until_it_answers(caplog, run):
    """A driver stops answering: there would be no new box, and the status would call all well to the end."""
    clock = Clock(0)
    failures = Failures(clock)

    def hang(_part):
        seen = []
        for _ in range(13):
            clock.now_ns += SECOND_NS
            seen.append([one.reason for one in failures.now])
        assert seen == [[]] * 11 + [["no answer for 10 s"]] * 2
        return "found"

    assert run(hang, failures, clock) == "found"
    assert not failures.now
    assert [one.partition(";")[0] for one in caplog.messages] == [
        "detector: no answer for 10 s",
        "detector: works again",
    ]
