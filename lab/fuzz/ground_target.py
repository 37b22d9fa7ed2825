"""A whole ground session: messages that parse, with any values in them, from the inbox to the recording."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from random import Random
from typing import NamedTuple

from hvt_common.protocol.messages import Info
from hvt_common.runtime.failures import Failures
from hvt_common.transport.inbox import Received
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import Session
from hvt_ground.sinks import Outputs
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from lab.fuzz.contract import Target, scratch
from lab.fuzz.mutate import Bytes, changed_values, joined, parted, with_checksum
from rigs.flight import Flight, Port, pipeline_of

_CHANNELS = ("base", "roi", "tracks", "status", "backlog")
_ATTACHED = ("base", "roi", "backlog")
_PACES = ("realtime", "lockstep")
_sinks = Outputs(Failures(time.time_ns))
_UNHARMED = 2
"""So many access units come unharmed before the rest."""


class _Item(NamedTuple):
    """One message in an input: its channel in one byte, the attachment behind its length, the payload."""

    channel: str
    attachment: bytes
    payload: bytes

    def packed(self) -> bytes:
        place = bytes([_CHANNELS.index(self.channel)])
        return place + len(self.attachment).to_bytes(2, "big") + self.attachment + self.payload

    @classmethod
    def parse(cls, data: bytes) -> _Item:
        channel = _CHANNELS[data[0] % len(_CHANNELS)] if data else "base"
        end = 3 + int.from_bytes(data[1:3], "big")
        return cls(channel, data[3:end], data[end:])


def _new_flight(pace: str) -> Flight:
    return Flight(10, keyframes=(6,), pace=pace, session_id=77)


_flight = cache(_new_flight)
"""The answer of the edge, and its first access units: nothing of it changes with use."""


def _opened(info: Info, reports: ReceiverReports) -> Session:
    settings = RecorderSettings.of(info, scratch() / "flight.rrd")
    return Session(
        info,
        sinks=[_sinks.open("recording", lambda: Recorder(settings))],
        pipeline_of=pipeline_of,
        clock=time.time_ns,
        reports=reports,
    )


def _session(data: bytes) -> None:
    pace, *messages = parted(data, least=1)
    port = Port()
    flight = port.flight = _flight(_PACES[len(pace) % len(_PACES)])
    ended: list[Session] = []
    edge = EdgeSessions(port, open_session=_opened, on_ended=ended.append)  # type: ignore[arg-type]
    for index in range(_UNHARMED):
        edge.handle(flight.base(index))
        edge.housekeep(pending=False)
    for one in map(_Item.parse, messages):
        key = f"hvt/uav-1/{one.channel}"
        edge.handle(Received(key, one.payload, one.attachment, "", time.time_ns()))
        edge.housekeep(pending=False)
    edge.close()
    _sinks.close(within_s=0.0)  # without footers
    assert ended, "the unharmed messages alone are a session"
    failed = {one.part for one in edge.failures.parts}
    assert failed <= {"video of uav-1"}, "which tells of messages of another version"
    assert all(len(session.reception.take_results(10_000)) < 5000 for session in ended)


def _changed(data: bytes, rng: Random, raw: Bytes) -> bytes:
    pace, *messages = parted(data, least=2)
    place = rng.randrange(len(messages))
    if rng.random() < 0.15:
        messages.insert(place, messages[rng.randrange(len(messages))])
    item = _Item.parse(messages[place])
    if item.channel in _ATTACHED:
        attachment, payload = item.attachment, item.payload
        if rng.random() < 0.2:
            payload = raw(payload)
        if rng.random() < 0.9:
            attachment = with_checksum(changed_values(attachment, rng, raw)[:-5], payload)
        item = _Item(item.channel, attachment, payload)
    else:
        item = _Item(item.channel, b"", changed_values(item.payload, rng, raw))
    messages[place] = item.packed()
    return joined([b"x" * rng.randrange(2) if rng.random() < 0.1 else pace, *messages])


def _seeds() -> Sequence[bytes]:
    box = {1: (30.0, 60.0, 62.0, 96.0)}
    seeds = []
    for number, pace in enumerate(_PACES):
        flight = _new_flight(pace)  # its track steps and statuses go on from message to message
        received = [
            [
                flight.base(2),
                flight.still(2, 0),
                flight.base(3),
                flight.status(base=4, roi=1),
                flight.base(4),
            ],
            [flight.step(2, box), flight.base(2), flight.step(3, box), flight.base(3), flight.still(3, 0)],
            [flight.base(5), flight.base(6), flight.still(1, 1, codec="residual", parameters={"b": 5})],
            [flight.status(base=2, state="ended"), flight.base(2)],
        ]
        for items in received:
            packed = [
                _Item(item.key.rpartition("/")[2], item.attachment, item.payload).packed() for item in items
            ]
            seeds.append(joined([b"x" * number, *packed]))
    return seeds


TARGETS = (
    Target(
        "ground-session",
        _session,
        _seeds,
        _changed,
        share=4,
        short=100,
        most_bytes=60_000,
        most_growth_mb=128,
    ),
)
