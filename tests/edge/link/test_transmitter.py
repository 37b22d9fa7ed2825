"""The place where bytes leave the edge: headers, ledger and budget."""

import random
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import Account, Ledger, overhead_bytes
from hvt_common.protocol.messages import (
    MAX_ALSO,
    AlsoShown,
    CaptureTimes,
    Flags,
    RoiHeader,
    Status,
    WireError,
)
from hvt_common.values import AccessUnit
from hvt_edge.link.budget import BASE_ATTACHMENT_BYTES, BudgetSettings, RollingBudget
from hvt_edge.link.feedback import PrimaryReceiver
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import RateController
from hvt_edge.link.stills import Still
from hvt_edge.video.encoder import STATUS_BYTES, base_overhead_bps
from rigs.messages import STATUS, feedback, still_of
from rigs.world import Puts, make_transmitter

SECOND_NS = 1_000_000_000
NOW_NS = 1_790_000_000 * SECOND_NS
JPEG = "image/jpeg"


class Out(Puts):
    """Which knows the line."""

    def line_bytes(self) -> int:
        keys = EdgeKeys("uav-1")
        return sum(
            len(payload)
            + len(extra)
            + overhead_bytes(len(payload), len(extra), key=keys[row], encoding=encoding)
            for row, payload, extra, encoding in self.puts
        )


class CountingBudget(RollingBudget):
    """Keeps the sizes that it was told of."""

    def __init__(self, settings: BudgetSettings) -> None:
        super().__init__(settings)
        self.sizes: list[int] = []

    def record_other(self, line_bytes: int, now_ns: int) -> None:
        super().record_other(line_bytes, now_ns)
        self.sizes.append(line_bytes)


class Rig:
    """A sender with all that it needs."""

    def __init__(
        self, *, total_bps: int = 800_000, lockstep: bool = False, pacer: Pacer | None = None
    ) -> None:
        self.out, self.ledger, self.waits = Out(), Ledger(), []
        self.budget = CountingBudget(BudgetSettings(total_bps, round(total_bps * 0.8), fps=15))
        parts = {"ledger": self.ledger, "budget": self.budget, "lockstep": lockstep, "pacer": pacer}
        self.sender = make_transmitter(self.out, **parts, session_id=2**32 - 1, wait_until=self.waits.append)


def unit(index: int, size: int = 1_000, *, keyframe: bool = False) -> AccessUnit:
    return AccessUnit(index, NOW_NS + index, bytes(size), keyframe=keyframe)


def still(size: int = 100, **changes) -> Still:
    facts = {"frame_index": 3, "capture_ns": NOW_NS, "track_id": 5, "class_name": "car", "reason": "utility"}
    place = {"box_source_px": (1.0, 2.0, 30.0, 40.0), "crop_source_px": (0, 0, 34, 45), "confidence": 0.5}
    return still_of(bytes(size), **(facts | place | changes))


def send_status(rig, make, **how) -> bool:
    return rig.sender.metadata(Channel.STATUS, lambda at_ns: make(at_ns).pack(), **how)


def status(at_ns: int, *, reasons: int = 0, name: str = "reason") -> Status:
    counts = {f"{name}{number}": 4_000_000_000 for number in range(reasons)}
    known = replace(STATUS, session_id=2**32 - 1, send_ns=at_ns, media_ns=max(0, at_ns - NOW_NS))
    return replace(known, sent=counts, deferred=counts, dropped=counts, failed=(), decisions="")


def send_units(rig, *keyframes: int, until: int, size: int = 1_000) -> int:
    for index in range(until):
        now_ns = NOW_NS + 66_000_000 * index
        rig.sender.base(unit(index, size, keyframe=index in keyframes), now_ns=now_ns)
    return NOW_NS + 66_000_000 * until


def test_what_a_ground_misses_goes_once_more_as_it_was():
    """A lost frame would cost all those behind it, up to the next keyframe."""
    rig = Rig()
    now_ns = send_units(rig, 0, until=6)
    rig.sender.in_flight.on_report(5, (2, 3))
    rig.sender.resend((2, 3), now_ns=now_ns)
    rig.sender.resend((2, 3, 9), now_ns=now_ns + SECOND_NS // 2)
    assert len(rig.out.puts) == 8, "it may be there by now, and what was never sent is nowhere"
    assert [one.sequence for one in rig.out.base[6:]] == [2, 3]
    for header in rig.out.base[6:]:
        assert header.flags == Flags.RESENT
        assert (header.frame_index, header.send_ns) == (header.sequence, now_ns)
    ledger = rig.sender.ledger
    assert ledger.messages(Account.BASE) == 6, "a ground that has all has so many"
    assert ledger.line_bytes == rig.out.line_bytes()
    rig.sender.in_flight.on_report(5, (3,))
    rig.sender.resend((2, 3), now_ns=now_ns + 790_000_000)
    assert [one.sequence for one in rig.out.base[8:]] == [3], "lost again"
    rig.sender.in_flight.on_report(5)
    assert len(rig.sender.in_flight) == 0


@pytest.mark.parametrize("why", ["a keyframe since", "too old", "lockstep"])
def test_what_is_of_no_use_does_not_go_again(why):
    """It would take the bits of pictures that are shown."""
    rig = Rig(lockstep=why == "lockstep")
    now_ns = send_units(rig, *((0, 5) if why == "a keyframe since" else (0,)), until=6)
    rig.sender.resend((3,), now_ns=now_ns + (SECOND_NS if why == "too old" else 0))
    assert len(rig.out.puts) == 6


def test_repetitions_keep_to_the_budget_and_to_a_share_of_it():
    """Whoever may report could have all of the link for pictures that were there before."""
    rig = Rig(total_bps=200_000)  # 25 kB in its window
    now_ns = send_units(rig, 0, until=15, size=1_400)
    rig.sender.resend(range(4, 15), now_ns=now_ns)
    again = rig.out.base[15:]
    assert 1 <= len(again) <= 4
    assert rig.ledger.worst_window_bps.total <= 200_000
    assert rig.sender.base(unit(20), now_ns=now_ns)
    assert rig.ledger.worst_window_bps.total <= 200_000
    assert [one.sequence for one in again] == list(range(4, 4 + len(again))), "none without those before it"
    later_ns = now_ns + 2 * SECOND_NS
    rig.sender.resend((14,), now_ns=later_ns - SECOND_NS)
    assert len(rig.out.base) > 16, "what had no room may go at the next report"


def test_a_base_message_says_what_the_ground_needs():
    """The ground could not order, check or date the pictures, or would show media time as delay."""
    rig = Rig()
    rig.sender.base(unit(4, keyframe=True), now_ns=NOW_NS + 100)
    rig.sender.base(unit(7), now_ns=NOW_NS + 200)
    told = [
        (one.session_id, one.sequence, one.frame_index, one.capture_ns, one.send_ns) for one in rig.out.base
    ]
    assert told == [(2**32 - 1, 0, 4, NOW_NS + 4, NOW_NS + 100), (2**32 - 1, 1, 7, NOW_NS + 7, NOW_NS + 200)]
    assert [one.flags for one in rig.out.base] == [Flags.KEYFRAME | Flags.PARAMETER_SETS, 0]
    assert [encoding for *_, encoding in rig.out.puts] == ["video/h265"] * 2
    assert rig.sender.base_sequence == 1
    lockstep = Rig(lockstep=True)
    lockstep.sender.base(unit(0, keyframe=True), now_ns=NOW_NS)
    lockstep.sender.still(still(), now_ns=NOW_NS)
    assert (lockstep.out.base[0].flags, lockstep.out.stills[0][0].flags) == (7, Flags.LOCKSTEP)


def test_a_still_says_what_it_shows():
    """The ground could not place it."""
    rig, sent = Rig(), still(sequence=6)
    rig.sender.still(sent, now_ns=NOW_NS + 50)
    ((header, payload),) = rig.out.stills
    assert header == replace(sent.header, session_id=2**32 - 1, send_delay_ns=50)
    assert (payload, rig.out.puts[0][3], rig.sender.still_sequence) == (sent.data, JPEG, 6)


def test_the_ledger_counts_the_very_bytes_that_were_put():
    """The account of the edge would not agree with that of the ground, nor with the bill."""
    rig = Rig(total_bps=10_000_000)
    for index in range(30):
        now_ns = NOW_NS + index * SECOND_NS // 15
        line = rig.sender.base(unit(index, 900 + 61 * index, keyframe=index == 0), now_ns=now_ns)
        _, payload, attachment, encoding = rig.out.puts[-1]
        around = overhead_bytes(len(payload), len(attachment), key="hvt/uav-1/base", encoding=encoding)
        assert line == len(payload) + len(attachment) + around
        if index % 3 == 0:
            rig.sender.still(still(300 + index, sequence=index // 3), now_ns=now_ns)
        if index % 15 == 0:
            send_status(rig, lambda at_ns: status(at_ns, reasons=3), now_ns=now_ns)
    assert rig.ledger.line_bytes == rig.out.line_bytes()
    assert rig.ledger.base_bytes == sum(map(len, rig.out.units))
    assert rig.ledger.roi_bytes == sum(len(data) for _, data in rig.out.stills)
    assert [rig.ledger.messages(one) for one in Account] == [30, 10, 0, 2]
    assert rig.ledger.line_bytes == sum(rig.budget.sizes)


def test_what_finds_no_room_is_sent_when_there_is_and_says_so():
    """The window would be overrun, or the ground's ledger would see other windows than the edge's."""
    rig = Rig(total_bps=80_000)  # 10 000 bytes a second
    rig.sender.base(unit(0, 6_000, keyframe=True), now_ns=NOW_NS)
    rig.sender.base(unit(1, 6_000), now_ns=NOW_NS + 100)
    send_status(rig, status, now_ns=NOW_NS + 200, last=True)
    assert rig.waits == [NOW_NS, NOW_NS + SECOND_NS, NOW_NS + SECOND_NS]
    assert rig.out.base[1].send_ns == Status.parse(rig.out.puts[2][1]).send_ns == NOW_NS + SECOND_NS
    assert rig.ledger.worst_window_bps.total <= 80_000


_NAMES = st.text(st.characters(codec="utf-8"), max_size=90) | st.sampled_from(["車" * 64, "é" * 64, "a" * 64])
_NUMBERS = st.integers(-(2**63) + 1, 2**63 - 1) | st.floats(-1e300, 1e300) | st.text("abc", max_size=64)
_FAR_BOXES = st.tuples(*[st.floats(-30_000, 0)] * 2, *[st.floats(0, 32_000)] * 2)


@given(
    class_name=_NAMES,
    reason=_NAMES,
    codec=st.text(st.characters(codec="ascii", categories=["L", "N"]), min_size=1, max_size=24),
    sequence=st.integers(0, 2**32 - 1),
    frame=st.integers(0, 2**32 - 1),
    track=st.integers(-1, 2**32 - 1),
    box=_FAR_BOXES,
    far=st.integers(0, 32_000),
    late_ns=st.integers(0, 2**40),
    media_type=st.sampled_from([JPEG, "image/webp", "image/avif", "application/vnd.hvt.residual"]),
    parameters=st.dictionaries(st.text("acdef", max_size=16), _NUMBERS, max_size=4),
    also=st.lists(st.tuples(st.integers(0, 2**32 - 1), _FAR_BOXES), max_size=MAX_ALSO),
    spend=st.integers(0, 15_000),
)
def test_a_still_of_just_the_room_takes_just_the_room(  # noqa: PLR0917 - hypothesis
    class_name, reason, codec, sequence, frame, track, box, far, late_ns, media_type, parameters, also, spend
):
    """A still with a long name or many tracks would overrun the window, or a usual one waste its admission."""
    rig = Rig()
    now_ns = NOW_NS + late_ns
    if spend:
        rig.sender.base(unit(0, spend), now_ns=now_ns)
    names = {"class_name": class_name, "reason": reason, "codec": codec, "media_type": media_type}
    numbers = {"sequence": sequence, "frame_index": frame, "track_id": track, "confidence": 0.9994}
    place = {"box_source_px": box, "crop_source_px": (far, far, far + 700, far + 700), "quality_pct": 100}
    others = tuple(AlsoShown(track_id=one, box_source_px=box) for one, box in also)
    asked = still(0, **names, **numbers, **place, parameters=parameters, also=others)
    room_line = rig.budget.still_allowance(now_ns)
    room = rig.sender.still_allowance_bytes(now_ns, still=asked)
    before = rig.ledger.line_bytes
    rig.sender.still(replace(asked, data=bytes(room)), now_ns=now_ns)
    encoding = rig.out.puts[-1][3]
    assert encoding == ("application/octet-stream" if "hvt" in media_type else media_type)
    taken = rig.ledger.line_bytes - before
    assert room == 0 or room_line - 72 <= taken <= room_line, "short by a header of TCP and one of a fragment"
    header, _ = rig.out.stills[-1]
    if class_name.isprintable():
        assert class_name.startswith(header.class_name)
        assert len(header.class_name.encode()) > 60 or header.class_name == class_name


def test_a_still_is_stamped_and_counted_when_it_goes_not_when_its_coding_began():
    """Windows on the line would be fuller than those of the account, and every still seem to take long on its way."""
    rig = Rig()
    rig.sender.clock = lambda: NOW_NS + 400_000_000
    rig.sender.still(still(), now_ns=NOW_NS)
    assert rig.out.stills[0][0].send_ns == NOW_NS + 400_000_000
    assert not rig.budget.fits(99_900, now_ns=NOW_NS + SECOND_NS + 200_000_000)


def test_before_there_is_a_still_the_room_is_that_of_a_usual_one():
    """The method would plan with room that no still has, or leave room unused."""
    rig = Rig()
    now_ns = NOW_NS + 10 * SECOND_NS
    usual = still(track_id=150, sequence=300, frame_index=900, box_source_px=(1.5, 900.0, 99.25, 999.0))
    exact = rig.sender.still_allowance_bytes(now_ns, still=usual)
    assert abs(rig.sender.still_allowance_bytes(now_ns) - exact) < 32
    assert abs(rig.sender.most_still_bytes() - exact) < 32


@pytest.mark.parametrize("channel", [Channel.TRACKS, Channel.POSE, Channel.STATUS])
def test_what_is_no_frame_waits_for_nothing_and_leaves_the_next_frame_its_room(channel):
    """The frame loop would sleep a second over a status, or the next frame over tracks."""
    rig = Rig(total_bps=80_000)  # 10 000 bytes a second, of which a frame takes 333 on average

    def send(now_ns: int, **late: bool) -> bool:
        if channel is Channel.STATUS:
            return send_status(rig, status, now_ns=now_ns, **late)
        return rig.sender.metadata(channel, lambda _at_ns: bytes(200), now_ns=now_ns)

    rig.sender.base(unit(0, 9_000, keyframe=True), now_ns=NOW_NS)
    assert not send(NOW_NS + 100)
    assert not send(NOW_NS + SECOND_NS // 2)
    assert rig.waits == [NOW_NS]
    assert rig.budget.earliest_ns(500, now_ns=NOW_NS + 100) == NOW_NS + 100, "a frame that fits goes before"
    assert send(NOW_NS + SECOND_NS + 1)
    assert rig.waits == [NOW_NS, NOW_NS + SECOND_NS + 1]
    row, _, attachment, encoding = rig.out.puts[-1]
    assert (row, attachment, encoding) == (channel, b"", DELIVERIES[channel].encoding)
    assert rig.ledger.messages(Account.META) == 1
    assert rig.ledger.line_bytes == rig.out.line_bytes()
    assert rig.ledger.line_bytes == sum(rig.budget.sizes)


def test_a_status_that_has_waited_long_goes_before_the_next_frame():
    """Where video takes all that there is, a ground would take the edge for gone."""
    rig = Rig(total_bps=80_000)
    rig.sender.base(unit(0, 9_150, keyframe=True), now_ns=NOW_NS)
    assert [send_status(rig, status, now_ns=NOW_NS + 100, before_frames=late) for late in (False, True)] == [
        False, True,
    ]  # fmt: skip
    assert rig.ledger.worst_window_bps.total <= 80_000


def test_a_reply_goes_at_once_is_counted_and_takes_no_room():
    """Whoever may ask could stop the video by asking, or bytes would leave that no account knows."""
    rig = Rig(total_bps=80_000)
    rig.sender.base(unit(0, 9_400, keyframe=True), now_ns=NOW_NS)
    before_bytes = rig.ledger.line_bytes
    for _ in range(100):
        assert rig.sender.reply(Channel.INFO, bytes(230)) == bytes(230)
    assert rig.waits == [NOW_NS]
    assert rig.ledger.replies == 100
    assert rig.ledger.reply_bytes == 100 * (
        230 + 65 + 52
    )  # `ss -ti` says 295 bytes a reply of 230, a segment each
    assert rig.ledger.line_bytes == before_bytes == sum(rig.budget.sizes)


@given(
    sequence=st.integers(-1, 2**32 - 2),
    frame=st.integers(0, 2**32 - 1),
    capture=st.integers(0, 2**62),
    late_ns=st.integers(0, 2**60),
    keyframe=st.booleans(),
)
def test_a_base_header_never_takes_more_than_is_counted_on(sequence, frame, capture, late_ns, keyframe):
    """The base would take more than its room, a few bytes in every message."""
    rig = Rig()
    rig.sender.base_sequence = sequence
    rig.sender.base(AccessUnit(frame, capture, bytes(9), keyframe=keyframe), now_ns=capture + late_ns)
    assert len(rig.out.puts[0][2]) <= BASE_ATTACHMENT_BYTES


def test_what_is_set_aside_for_headers_and_status_suffices():
    """x265 would be given bits that the headers need, and the base would exceed its share."""
    report = status(NOW_NS + 10**12, reasons=3, name="no_gain").pack()
    assert len(report) <= STATUS_BYTES
    rig = Rig(total_bps=50_000_000)
    for index in range(15):
        rig.sender.base(unit(index, 5_000), now_ns=NOW_NS + index * SECOND_NS // 15)
    send_status(rig, lambda at_ns: status(at_ns, reasons=3), now_ns=NOW_NS + SECOND_NS - 1)
    spent_bps = 8 * (rig.ledger.line_bytes - rig.ledger.base_bytes)
    aside_bps = base_overhead_bps(15 * 8 * 5_000, fps=15, edge_id="uav-1")
    assert spent_bps <= aside_bps <= 1.2 * spent_bps


def test_two_threads_keep_one_account():
    """Real-time runs would lose bytes from the ledger, or crash while a report is made."""
    rig = Rig(total_bps=400_000_000)

    def stills() -> None:
        for number in range(1_500):
            now_ns = NOW_NS + number * 1_000_000
            if rig.sender.still_allowance_bytes(now_ns, still=still()) > 200:
                rig.sender.still(still(200, sequence=number), now_ns=now_ns)
            rig.sender.outcome("deferred", f"reason{number % 20}")

    def report(at_ns: int) -> Status:
        account = rig.ledger.summary(1.0)
        assert account.line_bytes == sum(size for size in (rig.ledger.line_bytes,))
        return status(at_ns, reasons=len(rig.ledger.outcomes("deferred")))

    with ThreadPoolExecutor(1) as thread:
        done = thread.submit(stills)
        for number in range(1_500):
            now_ns = NOW_NS + number * 1_000_000
            rig.sender.base(unit(number, 500), now_ns=now_ns)
            if number % 10 == 0:
                send_status(rig, report, now_ns=now_ns)
    done.result()
    assert rig.ledger.line_bytes == rig.out.line_bytes()
    assert [one.sequence for one in rig.out.base] == list(range(1_500))
    assert sum(rig.ledger.outcomes("deferred").values()) == 1_500
    assert sum(rig.ledger.outcomes("sent").values()) == rig.ledger.messages(Account.ROI) > 0


def test_behind_the_last_report_goes_nothing():
    """A ground has closed the session: what a slow thread still had would be sent, counted and never received."""
    rig = Rig()
    rig.sender.still(still(), now_ns=NOW_NS)
    send_status(rig, status, now_ns=NOW_NS, last=True)
    before = rig.ledger.line_bytes, len(rig.out.puts)
    rig.sender.still(still(sequence=1), now_ns=NOW_NS)
    rig.sender.metadata(Channel.TRACKS, lambda _at_ns: bytes(40), now_ns=NOW_NS)
    assert (rig.ledger.line_bytes, len(rig.out.puts)) == before
    assert rig.ledger.outcomes("sent") == {"utility": 1}
    assert rig.ledger.outcomes("dropped") == {"ended": 1}


def test_a_second_copy_has_the_same_number_and_bytes_and_is_counted():
    """The ground would show it twice; or the budget and the account would not hold what crossed the line."""
    rig = Rig()
    stills = [still(400, sequence=sequence) for sequence in range(3)]
    for number, one in enumerate(stills):
        rig.sender.still(one, now_ns=NOW_NS + number * 1_000_000)
    now_ns = NOW_NS + 2_000_000
    line_bytes, allowance = rig.ledger.line_bytes, rig.sender.still_allowance_bytes(now_ns)
    rig.sender.still(stills[1], now_ns=now_ns, copy="again")
    (header, data), (copy, again) = rig.out.stills[1], rig.out.stills[3]
    assert data == again
    assert copy == replace(header, send_delay_ns=copy.send_delay_ns)
    assert (copy.send_ns, rig.sender.still_sequence, rig.ledger.messages(Account.ROI)) == (now_ns, 2, 4)
    assert rig.ledger.line_bytes - line_bytes > 400
    assert rig.sender.still_allowance_bytes(now_ns) < allowance - 400


def test_a_second_copy_does_not_confuse_the_pacer():
    """It would take reports for those of stills that were never sent, and the rate would fall to its floor."""
    pacer = Pacer(RateController(ceiling_bps=800_000, floor_bps=100_000))
    pacer.link(True, now_ns=NOW_NS)
    rig = Rig(pacer=pacer)
    stills = [still(400, sequence=sequence) for sequence in range(3)]
    for number, one in enumerate(stills):
        rig.sender.base(unit(number), now_ns=NOW_NS + number * 66_000_000)
        rig.sender.still(one, now_ns=NOW_NS + number * 66_000_000)
    rig.sender.still(stills[0], now_ns=NOW_NS + 1_300_000_000, copy="again")
    report = feedback(sequence=0, send_ns=NOW_NS, base_sequence=2, still_sequence=2)
    sent = (rig.sender.base_sequence, rig.sender.still_sequence)
    pacer.on_report(PrimaryReceiver().judge(report, sent=sent, now_ns=NOW_NS + 1_400_000_000))
    assert pacer.ignored == 0
    assert 0 < pacer.round_trip_ns < 1_400_000_000


def test_a_stored_still_has_the_bytes_that_it_would_have_had():
    """The ground could not place what comes back after an outage."""
    rig = Rig()
    rig.sender.still(still(400), now_ns=NOW_NS)
    stored = rig.sender.store_still(still(400), now_ns=NOW_NS)
    ((sent, data),) = rig.out.stills
    assert (stored.payload, stored.encoding) == (data, rig.out.puts[0][3])
    assert RoiHeader.parse(stored.attachment, data) == replace(sent, flags=Flags.STORED)


def test_the_time_of_a_frame_that_was_sent_is_not_sent_again():
    """Eight bytes of each still would say what the ground has; who asks for a still need not have the video."""
    rig = Rig()
    rig.sender.base(unit(3), now_ns=NOW_NS)
    for one in (still(), still(frame_index=4), still(parameters={"ask": 1})):
        rig.sender.still(one, now_ns=NOW_NS)
    stored = rig.sender.store_still(still(), now_ns=NOW_NS)
    (base,), headers = rig.out.base, [header for header, _ in rig.out.stills]
    assert [one.capture_ns for one in headers] == [-1, NOW_NS, NOW_NS]
    assert RoiHeader.parse(stored.attachment, stored.payload).capture_ns == NOW_NS
    captures = CaptureTimes()
    assert captures.filled(headers[0], otherwise_ns=7).capture_ns == 7, "nothing is known yet"
    captures.note(base)
    assert captures.filled(headers[0], otherwise_ns=7).capture_ns == NOW_NS + 3
    lost = replace(headers[0], frame_index=9)
    assert captures.filled(lost, otherwise_ns=7).capture_ns == NOW_NS + 3, "that of the nearest"
    assert captures.filled(headers[1], otherwise_ns=7) is headers[1]
    assert captures.filled(replace(headers[0], session_id=9), otherwise_ns=2**64).capture_ns == 2**63 - 1
    captures.note(replace(base, frame_index=5, capture_ns=NOW_NS + 203))
    assert captures.filled(lost, otherwise_ns=7).capture_ns == NOW_NS + 603, "by the rate of the two nearest"


def test_a_class_that_the_session_lists_is_sent_as_its_place_there():
    """Each still of a pedestrian would say so in eleven bytes; one on request, or stored, is read without a list."""
    rig, names = Rig(), ("van", "car")
    rig.sender.class_names = names
    for one in (still(), still(class_name="tram"), still(parameters={"ask": 1})):
        rig.sender.still(one, now_ns=NOW_NS)
    stored = rig.sender.store_still(still(), now_ns=NOW_NS)
    headers = [header for header, _ in rig.out.stills]
    assert [one.class_name for one in headers] == [1, "tram", "car"]
    assert [one.named(names).class_name for one in headers] == ["car", "tram", "car"]
    assert RoiHeader.parse(stored.attachment, stored.payload).class_name == "car"
    with pytest.raises(WireError, match="a still of class 1, where 1 are named"):
        headers[0].named(("van",))


@settings(max_examples=60)
@given(
    total_bps=st.sampled_from([12_000, 25_000, 100_000, 800_000]),
    fps=st.sampled_from([1, 2, 5, 15, 30]),
    seed=st.integers(0, 2**32 - 1),
)
def test_no_unit_breaks_a_window_however_large_it_is(total_bps, fps, seed):
    """A keyframe of twice the budget would be one second's worth, without a word."""
    rng, rig, left_out = random.Random(seed), Rig(total_bps=total_bps), 0
    for index in range(8 * fps):
        now_ns = NOW_NS + index * SECOND_NS // fps
        one = unit(index, round(total_bps / 8 * rng.choice([0.02, 0.1, 0.9, 1.0, 1.6])))
        sent = rig.sender.base(one, now_ns=now_ns)
        assert bool(sent) == rig.sender.holds(one)
        left_out += not sent
        send_status(rig, status, now_ns=now_ns, before_frames=rng.random() < 0.5)
        if (most_bytes := rig.sender.still_allowance_bytes(now_ns)) > 300:
            rig.sender.still(still(most_bytes, sequence=index), now_ns=now_ns)
    assert rig.ledger.worst_window_bps.total <= total_bps
    assert len([row for row, *_ in rig.out.puts if row is Channel.BASE]) + left_out == 8 * fps


def test_a_unit_that_no_message_carries_is_left_out():
    """One keyframe of a large picture would end the flight."""
    rig = Rig(total_bps=100_000_000)
    assert not rig.sender.base(unit(0, 4 * 2**20 + 1, keyframe=True), now_ns=NOW_NS)
    assert rig.sender.base_unit_wait_ns(unit(0, 4 * 2**20 + 1), now_ns=NOW_NS) is None
    assert rig.sender.base(unit(1, 4 * 2**20, keyframe=True), now_ns=NOW_NS)
    assert rig.sender.base_sequence == 0, "no number is missing"
