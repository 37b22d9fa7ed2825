"""Stills that are sent again, and what an outage leaves: from the account of reports to the very bytes."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Account, Ledger
from hvt_common.protocol.messages import Feedback, RoiHeader
from hvt_common.values import AccessUnit, Frame, Still, Tracks, View
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import RateController, RateSettings
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.link.unacknowledged import UnackedSettings, Unacknowledged
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.candidates import TrackMemory
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.policy.base import ranked
from hvt_edge.stills.scheduler import Chooser, ChooserSettings
from hvt_edge.stills.suppression import Suppression
from messages import feedback

MS = 1_000_000
S = 1_000_000_000
NOW = 1_700_000_000 * S
RTT = 80 * MS


def unit(index: int, size: int = 1_000) -> AccessUnit:
    """An access unit."""
    return AccessUnit(index, NOW + index * 66 * MS, bytes(size), keyframe=index == 0)


def still(sequence: int, size: int = 400, *, track: int | None = None) -> Still:
    """A still of a track of its own."""
    return Still(
        sequence=sequence,
        frame_index=sequence,
        capture_ns=NOW,
        track_id=100 + sequence if track is None else track,
        box_source_px=(1.0, 2.0, 30.0, 40.0),
        crop_source_px=(0, 0, 34, 45),
        class_name="car",
        confidence=0.5,
        reason="small",
        codec="jpeg",
        quality_pct=65,
        data=bytes([sequence % 256]) * size,
    )


def report(
    number: int, *, base: int = -1, still: int = -1, missing: tuple[int, ...] = (), receiver: int = 1
) -> Feedback:
    """What a ground says."""
    return feedback(
        receiver_id=receiver,
        sequence=number,
        send_ns=NOW,
        base_sequence=base,
        still_sequence=still,
        missing_stills=missing,
    )


def flown(stills: int = 4, bases: int = 4) -> Unacknowledged:
    """So many of each sent, 100 ms apart; the utility of a still is its number."""
    unacked = Unacknowledged()
    for index in range(bases):
        unacked.sent_base(index, unit(index), now_ns=NOW + index * 100 * MS)
    for index in range(stills):
        unacked.sent_still(still(index), utility=index, now_ns=NOW + index * 100 * MS)
    return unacked


def overdue(unacked: Unacknowledged, at_s: float, *, round_trip_ns: int = RTT) -> list[int]:
    """The sequences that are to be sent again."""
    return [
        one.sequence for one, _ in unacked.overdue_stills(NOW + round(at_s * S), round_trip_ns=round_trip_ns)
    ]


def left(unacked: Unacknowledged) -> tuple[list[int], list[int]]:
    """What an outage would hand over: frames, and stills by sequence."""
    units, stills = unacked.drain()
    return [one.frame_index for one in units], [one.sequence for one in stills]


# The account


def test_what_a_report_names_is_forgotten_and_what_is_missing_is_not():
    """After an outage the edge would store what the ground has, or lose what it has not."""
    unacked = flown()
    unacked.hear(report(0, base=2, still=3, missing=(1,)), now_ns=NOW + S)
    assert unacked.size_bytes == 1_000 + 400
    assert left(unacked) == ([3], [1])
    assert len(unacked) == unacked.size_bytes == 0
    assert left(unacked) == ([], [])


def test_an_outage_hands_over_frames_in_order_and_the_most_useful_still_first():
    """The store would keep the least useful, or a video that cannot be decoded."""
    assert left(flown()) == ([0, 1, 2, 3], [3, 2, 1, 0])


def test_memory_is_bounded_and_the_oldest_leaves_first():
    """A ground that never reports would let the edge grow for the whole flight."""
    unacked = Unacknowledged(UnackedSettings(max_base_bytes=10_000, max_stills=5, max_still_bytes=1_500))
    for index in range(60):
        unacked.sent_base(index, unit(index), now_ns=NOW + index * 10 * MS)
        unacked.sent_still(still(index, 400), utility=1.0, now_ns=NOW + index * 10 * MS)
    assert unacked.size_bytes <= 11_500
    assert left(unacked) == (list(range(50, 60)), [57, 58, 59])


def test_video_of_more_than_four_seconds_ago_is_not_kept():
    """What was lost so long ago belongs to another outage."""
    unacked = Unacknowledged()
    for index in range(10):
        unacked.sent_base(index, unit(index), now_ns=NOW + index * S)
    assert left(unacked)[0] == [5, 6, 7, 8, 9]


def test_the_first_receiver_counts_until_it_is_silent():
    """A second ground nearby would acknowledge what the first, behind the thin link, never got; or nobody would."""
    unacked = flown()
    unacked.hear(report(0, base=0, receiver=1), now_ns=NOW + 400 * MS)
    unacked.hear(report(0, base=3, still=3, receiver=2), now_ns=NOW + 500 * MS)
    assert len(unacked) == 3 + 4
    unacked.hear(report(1, base=1, receiver=1), now_ns=NOW + 1_000 * MS)
    unacked.hear(report(1, base=3, still=3, receiver=2), now_ns=NOW + 1_900 * MS)
    assert len(unacked) == 2 + 4
    unacked.hear(report(2, base=3, still=3, receiver=2), now_ns=NOW + 2_100 * MS)
    assert len(unacked) == 0


def test_old_forged_and_repeated_reports_acknowledge_nothing():
    """One invented number would let the edge forget what the ground never got."""
    unacked = flown()
    unacked.hear(report(0, base=4), now_ns=NOW + S)
    unacked.hear(report(0, base=0, still=4), now_ns=NOW + S)
    assert len(unacked) == 8
    unacked.hear(report(9, base=0, receiver=5), now_ns=NOW + S)  # the liars were not followed
    assert len(unacked) == 7
    unacked.hear(report(8, base=3, receiver=5), now_ns=NOW + S)
    assert len(unacked) == 7


def test_a_forged_report_number_silences_acknowledgements_for_a_second_only():
    """Stills would be sent again, and after an outage stored and shown once more, for the rest of the flight."""
    unacked = flown()
    unacked.hear(report(2**32 - 1, base=0), now_ns=NOW + 500 * MS)
    unacked.hear(report(5, base=1), now_ns=NOW + 1_000 * MS)
    assert len(unacked) == 7, "late ones are left out as ever"
    unacked.hear(report(12, base=3, still=3), now_ns=NOW + 1_600 * MS)
    assert len(unacked) == 0


# What is sent again


def test_a_still_is_overdue_when_a_report_ought_to_have_named_it():
    """Stills would be sent twice while they are on their way, or not at all; the most useful first."""
    unacked = flown()
    unacked.hear(report(0, base=0, still=1, missing=(0,)), now_ns=NOW + 1_250 * MS)
    assert overdue(unacked, 1.25) == [2, 0]
    assert overdue(unacked, 1.25, round_trip_ns=400 * MS) == [0]
    assert overdue(unacked, 1.25, round_trip_ns=420 * MS) == []
    assert overdue(unacked, 2.0) == [2, 0]  # 3 was sent too shortly before the last report


def test_in_silence_nothing_is_overdue():
    """Into an outage, or to a receiver that never reports, every still would be sent twice."""
    unacked = flown()
    assert overdue(unacked, 3.0) == []
    unacked.hear(report(0, base=0), now_ns=NOW + 300 * MS)
    assert overdue(unacked, 3.0) == []


def test_each_is_sent_again_once_and_only_while_it_is_young():
    """A still that cannot get through would take the budget of all others."""
    unacked = flown()
    for number, at_ms in enumerate(range(500, 5_000, 500)):
        unacked.hear(report(number, base=0), now_ns=NOW + at_ms * MS)
    assert overdue(unacked, 3.9) == [3, 2, 1, 0]
    unacked.sent_still(still(2), utility=2.0, now_ns=NOW + 3_900 * MS)
    assert overdue(unacked, 4.1) == [3, 1]
    assert overdue(unacked, 4.5) == []
    assert left(unacked)[1] == [3, 2, 1, 0], "what never arrived can still be stored"


def test_a_second_copy_of_what_has_arrived_meanwhile_is_not_kept():
    """It would be stored, and shown once more, after the next outage."""
    unacked = flown()
    unacked.hear(report(0, base=3, still=3), now_ns=NOW + 2 * S)
    unacked.sent_still(still(2), utility=2.0, now_ns=NOW + 2 * S)
    assert left(unacked) == ([], [])


def test_frame_loop_still_thread_and_link_may_speak_at_once():
    """The edge would crash in flight, once in a thousand."""
    unacked, errors = Unacknowledged(UnackedSettings(max_stills=8)), []

    def run(work) -> None:
        try:
            for index in range(800):
                work(index)
        except Exception as error:  # noqa: BLE001 - told in the main thread
            errors.append(error)

    threads = [
        threading.Thread(target=run, args=[work])
        for work in (
            lambda index: unacked.sent_base(index, unit(index, 10), now_ns=NOW + index * MS),
            lambda index: unacked.sent_still(still(index, 10), utility=1.0, now_ns=NOW + index * MS),
            lambda index: unacked.hear(
                report(index, base=index - 5, still=index - 5), now_ns=NOW + index * MS
            ),
            lambda index: unacked.overdue_stills(NOW + index * MS, round_trip_ns=0),
            lambda index: unacked.drain() if index % 50 == 0 else None,
        )
    ]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert errors == []
    unacked.drain()
    assert unacked.size_bytes == 0


# Sending


class Rig:
    """A real sender with budget, pacer and account, into a list; now and then a ground says what it has."""

    def __init__(self, *, total_bps: int = 800_000) -> None:
        self.puts: list[tuple[Channel, bytes, bytes]] = []
        self.ledger, self.unacked = Ledger(), Unacknowledged()
        self.pacer = Pacer(RateController(RateSettings(ceiling_bps=total_bps, floor_bps=100_000)))
        self.sender = Transmitter(
            self,
            ledger=self.ledger,
            budget=RollingBudget(BudgetSettings(total_bps, round(total_bps * 0.8), fps=15)),
            edge_id="uav-1",
            session_id=7,
            lockstep=False,
            wait_until=lambda _at_ns: None,
            pacer=self.pacer,
            unacked=self.unacked,
        )

    def put(self, row, payload, *, attachment=None, encoding="") -> None:
        """Keep it."""
        self.puts.append((row, payload, attachment or b""))

    @property
    def stills(self) -> list[tuple[RoiHeader, bytes]]:
        """What went out on ``roi``."""
        return [(RoiHeader.parse(extra, data), data) for row, data, extra in self.puts if row is Channel.ROI]


def test_a_second_copy_has_the_same_number_and_bytes_and_is_counted():
    """The ground would show it twice; or the budget and the account would not hold what crossed the line."""
    rig = Rig()
    for sequence in range(3):
        rig.sender.still(still(sequence), now_ns=NOW + sequence * MS, utility=1.0)
    line_bytes = rig.ledger.line_bytes
    room = rig.sender.still_room_bytes(NOW + 2 * MS)
    rig.sender.still(still(1), now_ns=NOW + 2 * MS, utility=1.0)
    (header, data), (copy, again) = rig.stills[1], rig.stills[3]
    assert data == again == still(1).data
    assert copy == replace(header, send_delay_ns=copy.send_delay_ns)
    assert copy.send_ns == NOW + 2 * MS
    assert rig.sender.still_sequence == 2
    assert rig.ledger.messages(Account.ROI) == 4
    assert rig.ledger.line_bytes - line_bytes > 400
    assert rig.sender.still_room_bytes(NOW + 2 * MS) < room - 400


def test_a_second_copy_does_not_confuse_the_pacer():
    """It would ignore all further reports, as of what was never sent, and the rate would fall to its floor."""
    rig = Rig()
    for sequence in range(3):
        rig.sender.base(unit(sequence), now_ns=NOW + sequence * 66 * MS)
        rig.sender.still(still(sequence), now_ns=NOW + sequence * 66 * MS)
    rig.sender.still(still(0), now_ns=NOW + 1_300 * MS)
    rig.pacer.hear(report(0, base=2, still=2), now_ns=NOW + 1_400 * MS)
    assert rig.pacer.ignored == 0
    assert rig.pacer._flight.size_bytes == 0
    assert 0 < rig.pacer.round_trip_ns < 1_400 * MS


# Choosing


class _Wants:
    """Wishes for a still of each track, by its id."""

    name, video_only = "test", False

    def requests(self, candidates, step):
        """The higher the id, the more."""
        return ranked(candidates, score=lambda one: float(one.track_id), reason="test")


class Choice:
    """A chooser at one decision step, with stills that are overdue."""

    def __init__(self, *lost: tuple[Still, float]) -> None:
        self.lost = list(lost)
        self.outcomes: Counter[tuple[str, str]] = Counter()
        size = (320, 192)
        self.chooser = Chooser(
            _Wants(),
            suppression=Suppression.for_cooldown(1.0),
            maker=StillMaker(),
            memory=TrackMemory(),
            view=View.fitted(size, size, fit="letterbox"),
            class_names=("car",),
            settings=ChooserSettings(fps=3, most_bytes=50_000),
            on_outcome=lambda outcome, reason: self.outcomes.update([(outcome, reason)]),
            overdue=lambda _now_ns: tuple(self.lost),
        )
        self.picture = np.random.default_rng(1).integers(0, 255, (size[1], size[0], 3), np.uint8)

    def wish(self, *tracks: int) -> None:
        """These tracks are seen, and wanted."""
        count = len(tracks)
        boxes = np.array([[20.0 + 40 * i, 20, 50 + 40 * i, 50] for i in range(count)], np.float32)
        seen = Tracks(
            0,
            np.array(tracks, np.int64),
            boxes.reshape(count, 4),
            np.full(count, 0.5, np.float32),
            np.zeros(count, np.int32),
            np.zeros(count, np.int64),
            np.zeros(count, np.int64),
            np.zeros(count, np.bool_),
        )
        frame = Frame(0, NOW, self.picture, self.picture)
        flat = np.full_like(self.picture, 128)
        self.chooser.consider(AnalyzedFrame(frame, flat, seen, detected=True), now_ns=NOW, room_bytes=1000)

    def stills(self, room: int = 100_000) -> list[tuple[int, float]]:
        """Send what fits: (track, utility) of each."""
        sent, left = [], [room]
        for one in self.chooser.stills(now_ns=NOW, room=lambda _still: left[-1]):
            assert len(one.data) <= left[-1]
            left.append(left[-1] - len(one.data))
            self.lost = [(other, utility) for other, utility in self.lost if other is not one]
            sent.append((one.track_id, self.chooser.utility))
        return sent


def test_a_lost_still_goes_before_wishes_that_are_less_useful():
    """The link's loss would decide what is seen, not the policy."""
    choice = Choice((still(7, track=50), 2.5), (still(6, track=51), 0.5))
    choice.wish(1, 2, 3)
    assert choice.stills() == [(3, 3.0), (50, 2.5), (2, 2.0), (1, 1.0), (51, 0.5)]
    assert choice.outcomes == {("sent", "test"): 3, ("sent", "again"): 2}
    assert choice.chooser._sequence == 3, "a second copy takes no number"


def test_a_lost_still_without_room_holds_up_nobody():
    """A large one would let all others grow old, and then be too old itself."""
    choice = Choice((still(7, 9_000, track=50), 9.0))
    choice.wish(1)
    assert choice.stills(8_000) == [(1, 1.0)]
    assert choice.stills(9_000) == [(50, 9.0)]


def test_a_lost_still_gives_way_to_a_newer_of_its_track():
    """The operator would see the past of a car in place of its present."""
    choice = Choice((still(7, track=3), 9.0))
    choice.wish(3)
    assert choice.stills(10) == []
    assert choice.stills()[0] == (3, 3.0)


@pytest.mark.parametrize("room", [0, 399])
def test_a_lost_still_keeps_to_the_budget(room):
    """Loss would make the edge spend more than it was given, on a link that has less."""
    choice = Choice((still(7, 400, track=50), 9.0))
    assert choice.stills(room) == []
    assert choice.stills(400) == [(50, 9.0)]
