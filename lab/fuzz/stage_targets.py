"""Messages that parse, against the stages behind the parser: reassembly, commands, reports."""

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from hvt_common.protocol.messages import MAX_MISSING_BASE, ControlRequest, Feedback, Flags, WireError
from hvt_edge.link.feedback import FeedbackInbox, PrimaryReceiver
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import RateController
from hvt_ground.link.reassemble import REORDER_UNITS, RESEND_UNITS, Arrival, Reassembler
from lab.fuzz.contract import Target
from lab.fuzz.message_targets import REQUESTS, feedback
from lab.fuzz.mutate import changed_parts, joined, parted
from rigs.command_rig import SESSION, Rig

_MS = 1_000_000
_STEP = struct.Struct("<BbbH")
"""A base message: session and flags, sequence and frame index as differences from the last message, milliseconds.

An odd number of these: it is sent once more. A byte behind the last: the edge does so.
"""
_FAR = (0, 1 << 10, 1 << 31, 1 << 63)


@dataclass(frozen=True, slots=True)
class _Header:
    session_id: int
    sequence: int
    frame_index: int
    keyframe: bool
    flags: Flags


def _base_messages(data: bytes) -> Iterator[tuple[_Header, int]]:
    sequence = frame_index = 0
    for bits, step, frames, wait_ms in _STEP.iter_unpack(data[: len(data) // _STEP.size * _STEP.size]):
        sequence = max(0, sequence + step + _FAR[bits >> 3 & 3] * (bits >> 7))
        frame_index = max(0, frame_index + frames + _FAR[bits >> 5 & 3] * (bits >> 7))
        flags = Flags.RESENT if wait_ms % 2 else Flags(0)
        yield _Header(bits & 3, sequence, frame_index, bool(bits & 4), flags), wait_ms


def _reassembly(data: bytes) -> None:
    core: Reassembler = Reassembler()
    core.repair.round_trip_ns = 60 * _MS if len(data) % _STEP.size else None
    now_ns, last = 5_000 * _MS, None
    for header, wait_ms in _base_messages(data):
        now_ns += wait_ms * _MS
        for arrival in core.accept(header, b"", now_ns=now_ns):
            last = _checked(arrival, last)
        if core.wants_keyframe(now_ns):
            core.keyframe_requested(now_ns)
        assert len(core._held) <= (RESEND_UNITS if core.repair.round_trip_ns else REORDER_UNITS)
        assert len(core.missing) <= MAX_MISSING_BASE
        assert len(core._left) <= 16


def _checked(arrival: Arrival, last: _Header | None) -> _Header | None:
    """A decoder gets runs that begin with a keyframe and have no hole."""
    if arrival.verdict != "decode":
        return last
    header = arrival.header
    if arrival.starts_run or last is None:
        assert header.keyframe
    else:
        assert (header.session_id, header.sequence) == (last.session_id, last.sequence + 1)
        assert header.frame_index > last.frame_index
    return header


def _reassembly_seeds() -> list[bytes]:
    whole = [_STEP.pack(5 if n == 0 else 1, 1, 1, 66) for n in range(30)]
    lost = [*whole[:8], _STEP.pack(1, 4, 4, 66), *whole[:4], _STEP.pack(5, 1, 1, 200), *whole[1:9]]
    other = [*whole[:8], _STEP.pack(6, -8, -8, 700), *[_STEP.pack(2, 1, 1, 66)] * 6]
    forged = [*whole[:8], _STEP.pack(0x9D, 1, 1, 66), *whole[1:9], _STEP.pack(5, -100, -100, 2500)]
    again = [*whole[:8], _STEP.pack(1, 2, 2, 66), _STEP.pack(1, -1, -1, 61), b"!"]
    return [b"".join(messages) for messages in (whole, lost, other, forged, again)]


# The edge's side


@cache
def _rig() -> Rig:
    rig = Rig()
    rig.run(12)
    return rig


def _commands(data: bytes) -> None:
    """Requests to a flying edge, some of which are kept from one input to the next: as grounds would leave it."""
    rig = _rig()
    for part in parted(data)[:4]:
        with contextlib.suppress(WireError):
            request = ControlRequest.parse(part)
            rig.request_ns += 50 * _MS
            answer = rig.commands.answer(request)
            assert answer.accepted != bool(answer.reason)
            assert answer.pack()
    assert rig.outbox.on_demand_pending <= 4
    assert rig.reconfiguration.count == 0, "the video has its own time to change"
    if rig.request_ns % (200 * 50 * _MS) == 0:
        rig.run(1)
        rig.out.puts.clear()  # the link of a rig keeps all that is sent


def _command_seeds() -> list[bytes]:
    return [joined([one.pack()]) for one in REQUESTS] + [joined([one.pack() for one in REQUESTS[:4]])]


def _reports(data: bytes) -> None:
    pacer = Pacer(RateController(ceiling_bps=800_000, floor_bps=100_000))
    primary, inbox, now_ns = PrimaryReceiver(), FeedbackInbox(), 1_790_000_000_000 * _MS
    for n in range(60):
        pacer.sent_base(n, 5000, now_ns=now_ns + n * 66 * _MS, keyframe=n == 0)
    now_ns += 61 * 66 * _MS
    for part in parted(data):
        now_ns += 120 * _MS
        with contextlib.suppress(WireError):
            report = primary.judge(Feedback.parse(part), sent=(59, -1), now_ns=now_ns)
            inbox.on_report(report)
            pacer.on_report(report)
        pacer.admits_base(now_ns)
        pacer.admits_still(now_ns)
        assert 100_000 <= pacer.rate_bps <= 800_000
        assert len(inbox.take()) <= 1024


def _report_seeds() -> list[bytes]:
    reports = [
        feedback(
            sequence=n,
            session_id=SESSION,
            base_sequence=20 + 10 * n,
            send_ns=1_790_000_002_000_000_000 + n * 120 * _MS,
        ).pack()
        for n in range(4)
    ]
    return [joined(reports), joined(reports[:1])]


TARGETS = (
    Target("reassembly", _reassembly, _reassembly_seeds, share=60, short=1500, most_bytes=_STEP.size * 60),
    Target("commands", _commands, _command_seeds, changed_parts, share=30, short=1500, most_bytes=3000),
    Target("reports", _reports, _report_seeds, changed_parts, share=20, short=600, most_bytes=6000),
)
