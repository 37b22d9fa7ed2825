"""A whole ground session: messages that parse, with any values in them, from the account to the recording."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from random import Random
from typing import NamedTuple
from unittest.mock import patch

from flight import SIZE, Flight, Port, pipeline_of
from hvt_common.protocol.messages import Info, TrackStepEncoder
from hvt_common.transport.inbox import Received
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.receiver_report import ReceiverReports
from hvt_ground.session.session import GroundSession
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from lab.fuzz.contract import Target
from lab.fuzz.mutate import Bytes, resealed, sealed_values
from lab.fuzz.parts import joined, parted
from lab.fuzz.scratch import scratch

__all__ = ["TARGETS"]

_ROWS = ("base", "roi", "tracks", "status", "backlog")
_ATTACHED = ("base", "roi", "backlog")
_PACES = ("realtime", "lockstep")
_HEARD = 2
"""So many access units come unharmed before the rest."""


class _Said(NamedTuple):
    """One message in an input: its row in one byte, the attachment behind its length, the payload."""

    row: str
    attachment: bytes
    payload: bytes

    def packed(self) -> bytes:
        return (
            bytes([_ROWS.index(self.row)])
            + len(self.attachment).to_bytes(2, "big")
            + self.attachment
            + self.payload
        )

    @classmethod
    def parse(cls, data: bytes) -> _Said:
        row = _ROWS[data[0] % len(_ROWS)] if data else "base"
        end = 3 + int.from_bytes(data[1:3], "big")
        return cls(row, data[3:end], data[end:])


@cache
def _flight(pace: str) -> Flight:
    flight = Flight(10, keyframes=(6,), pace=pace)
    flight.session_id = 77
    flight._steps = TrackStepEncoder(session_id=77)
    return flight


def _opened(info: Info, reports: ReceiverReports) -> GroundSession:
    settings = RecorderSettings(
        path=scratch() / "flight.rrd",
        edge_id="uav-1",
        session="77",
        base_size=info.base_size,
        fps=info.fps,
        budget_bps=info.budget_bps,
    )
    return GroundSession(
        info,
        sinks=[Recorder(settings)],
        pipeline_of=pipeline_of,
        clock=time.time_ns,
        reports=reports,
    )


def _session(data: bytes) -> None:
    pace, *messages = parted(data, least=1)
    flight = _flight(_PACES[len(pace) % len(_PACES)])
    port = Port()
    port.flight = flight
    port.present.set()
    edge = EdgeSessions(port, open_session=_opened)  # type: ignore[arg-type]
    for index in range(_HEARD):
        edge.handle(flight.base(index))
        edge.housekeep(pending=False)
    for one in map(_Said.parse, messages):
        key = f"hvt/uav-1/{one.row}"
        edge.handle(Received(key, one.payload, one.attachment, "", time.time_ns()))
        edge.housekeep(pending=False)
    session = edge.session
    if session is not None:
        assert len(session.take_results(10_000)) < 5000
    with patch("hvt_ground.sinks.rerun.rrd_file.add_footer"):  # a process of its own for each input
        edge.close()


def _changed(data: bytes, rng: Random, raw: Bytes) -> bytes:
    pace, *messages = parted(data, least=2)
    place = rng.randrange(len(messages))
    if rng.random() < 0.15:
        messages.insert(place, messages[rng.randrange(len(messages))])
    said = _Said.parse(messages[place])
    if said.row in _ATTACHED:
        attachment, payload = said.attachment, said.payload
        if rng.random() < 0.2:
            payload = raw(payload)
        if rng.random() < 0.9:
            attachment = resealed(sealed_values(attachment, rng, raw)[:-5], payload)
        said = _Said(said.row, attachment, payload)
    else:
        said = _Said(said.row, b"", sealed_values(said.payload, rng, raw))
    messages[place] = said.packed()
    return joined([b"x" * rng.randrange(2) if rng.random() < 0.1 else pace, *messages])


def _seeds() -> Sequence[bytes]:
    seeds = []
    for number, pace in enumerate(_PACES):
        flight = _flight(pace)
        box = {1: (30.0, 60.0, 62.0, 96.0)}
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
            said = [
                _Said(item.key.rpartition("/")[2], item.attachment, item.payload).packed() for item in items
            ]
            seeds.append(joined([b"x" * number, *said]))
    assert SIZE == (320, 192)
    return seeds


TARGETS = (
    Target(
        "ground-session",
        _session,
        _seeds,
        mutate=_changed,
        share=4,
        short=4,
        most_bytes=60_000,
        most_growth_mb=128,
    ),
)
