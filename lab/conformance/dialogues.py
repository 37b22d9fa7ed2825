"""Vectors of what a ground makes of messages: reports, objects of the backlog from their chunks, sizes of stills."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.messages import BacklogHeader, BacklogKind, WireError
from hvt_common.transport.inbox import Received
from hvt_common.values import View
from hvt_common.video.still_codecs import StillError
from hvt_ground.backlog.assembly import BacklogAssembly
from hvt_ground.link.reception import Reception
from hvt_ground.perception.stills.decode import coded_size
from rigs.messages import BACKLOG, BASE, INFO, ROI

_SESSION = 2**63 + 9
_SOURCE = (4000, 3000)
_DATA = bytes(range(40))
_OBJECTS = {
    7: (_SESSION, BacklogKind.STILL, 7),
    8: (_SESSION, BacklogKind.STILL, 8),
    17: (_SESSION + 1, BacklogKind.STILL, 7),
    27: (_SESSION, BacklogKind.BASE, 7),
}
_Chunk = tuple[int, int, int, int]
"""Which of the objects, offset, end, total."""
_Event = _Chunk | bool
"""Or whether the object that was completed last is usable."""
_DIALOGUES: tuple[tuple[str, tuple[_Event, ...]], ...] = (
    (
        "an object, and its end once more",
        ((7, 0, 15, 40), (7, 15, 30, 40), (7, 30, 40, 40), True, (7, 39, 40, 40)),
    ),
    ("a chunk is lost", ((7, 0, 15, 40), (7, 30, 40, 40), (7, 15, 30, 40), (7, 30, 40, 40), True)),
    ("a chunk before any other", ((7, 15, 30, 40), (7, 0, 15, 40))),
    ("chunks overlap", ((7, 0, 20, 40), (7, 10, 30, 40), (7, 0, 10, 40), (7, 5, 40, 40), True)),
    ("the end comes again while it is processed", ((7, 0, 40, 40), (7, 39, 40, 40), True, (7, 0, 40, 40))),
    ("the total changes while it is processed", ((7, 0, 40, 40), (7, 0, 20, 30), True, (7, 39, 40, 40))),
    ("an unusable object", ((7, 0, 40, 40), False, (7, 0, 40, 40), True)),
    ("the total changes", ((7, 0, 20, 40), (7, 20, 25, 30), (7, 0, 30, 30), True)),
    ("the total changes after the end", ((7, 0, 30, 30), True, (7, 0, 20, 40), (7, 20, 40, 40), True)),
    ("two objects in turn", ((7, 0, 20, 40), (8, 0, 10, 10), True, (7, 20, 40, 40), True)),
    ("three of one number", ((7, 0, 20, 40), (17, 0, 10, 40), (27, 0, 15, 40), (7, 20, 40, 40), True)),
    (
        "no bytes, and too many",
        ((7, 0, 20, 40), (7, 20, 20, 40), (7, 20, 40, 39), (7, 20, 40, 40), True),
    ),
)
_SIZES: tuple[tuple[str, tuple[int, int, int, int], tuple[int, int] | None], ...] = (
    ("as large as its crop", (0, 0, 500, 300), None),
    ("at the source's far corner", (3900, 2900, 4000, 3000), None),
    ("beyond the source's right side", (3900, 2900, 4001, 3000), None),
    ("beyond the source's lower side", (3900, 2900, 4000, 3001), None),
    ("smaller than its crop", (0, 0, 1000, 600), (500, 300)),
    ("a plain picture of far fewer pixels than the base has", (0, 0, 4000, 3000), (8, 6)),
    ("wider than its crop", (0, 0, 500, 300), (501, 300)),
    ("higher than its crop", (0, 0, 500, 300), (500, 301)),
    ("as large as a still may be", (0, 0, 2048, 2048), None),
    ("a pixel too wide", (0, 0, 2049, 100), None),
    ("a pixel too high", (0, 0, 100, 2049), None),
    ("as large as one that nobody requested may be", (0, 0, 512, 512), None),
    ("a pixel too wide for one that nobody requested", (0, 0, 513, 100), None),
    ("a pixel too high for one that nobody requested", (0, 0, 100, 513), None),
    ("of another shape by just as much as may be", (0, 0, 100, 50), (52, 25)),
    ("of another shape by a little more", (0, 0, 100, 50), (53, 25)),
)

_REPORT = "report"
_TRACES: tuple[tuple[str, tuple[tuple[str, int, int, float | None], ...]], ...] = (
    ("nothing yet", ((_REPORT, 0, 0, None),)),
    (
        "all arrives",
        (("base", 0, 0, 20.5), ("still", 0, 5, None), ("base", 1, 40, 21.5), (_REPORT, 0, 47, None)),
    ),
    (
        "two stills are missing, one comes again, one with the backlog",
        (
            *(("base", 0, 0, None), ("still", 0, 5, None), ("still", 3, 9, None), (_REPORT, 0, 10, None)),
            *(
                ("still", 1, 15, None),
                (_REPORT, 0, 20, None),
                ("stored", 2, 30, None),
                (_REPORT, 0, 40, None),
            ),
        ),
    ),
    (
        "a ground that comes later misses nothing that was before it",
        (
            *(("base", 50, 0, None), ("still", 40, 5, None), (_REPORT, 0, 10, None)),
            *(("still", 42, 15, None), (_REPORT, 0, 20, None)),
        ),
    ),
    (
        "one that was there from the start does",
        (("base", 0, 0, None), ("still", 2, 5, None), (_REPORT, 0, 9, None)),
    ),
    (
        "a still is missed for six seconds",
        (
            *(("still", 7, 0, None), ("still", 9, 100, None)),
            *((_REPORT, 0, 6_100, None), (_REPORT, 0, 6_101, None)),
        ),
    ),
    (
        "of many the newest are named",
        (
            *(("still", 0, 0, None), ("still", 100, 5, None), (_REPORT, 0, 6, None)),
            *(("still", 105, 7, None), (_REPORT, 0, 8, None)),
        ),
    ),
    (
        "the highest counts, and when it came",
        (
            ("base", 3, 0, None),
            ("base", 5, 10, None),
            ("base", 5, 15, None),
            ("base", 4, 20, None),
            ("still", 4, 21, None),
            ("still", 3, 22, None),
            (_REPORT, 0, 30, None),
        ),
    ),
    (
        "the median of the delays since the last report",
        (
            *(("base", 0, 0, 9.5), ("base", 1, 1, 4.5), ("base", 2, 2, 6.0), (_REPORT, 0, 3, None)),
            *(("base", 3, 4, 5.0), ("base", 4, 5, 8.0), (_REPORT, 0, 6, None), (_REPORT, 0, 7, None)),
        ),
    ),
)
"""What came, its number, when in ms, its delay."""
_OTHERS: Any = dict.fromkeys(("receiver_id", "sequence", "clock_offset_ns"), 0)
_OTHERS |= {"clock_error_ns": -1, "backlog": ()}
"""Fields of a report that others fill."""


def report_traces() -> Iterator[dict[str, Any]]:
    """What came and when, and the fields of the reports between."""
    for name, events in _TRACES:
        timed = any(delay_ms is not None for *_, delay_ms in events)
        info = replace(INFO, pace="realtime" if timed else "lockstep")  # in which no delay is known
        counted = Reception(info, clock=int, edge_clock=ClockOffset(), emit=lambda _event: None)
        steps: list[dict[str, Any]] = []
        for kind, number, at_ms, delay_ms in events:
            at_ns = at_ms * 1_000_000
            if kind == _REPORT:
                said = counted.feedback(send_ns=at_ns, **_OTHERS)
                steps.append(
                    {
                        "report_at_ms": at_ms,
                        "base_sequence": said.base_sequence,
                        "base_held_us": said.base_held_us,
                        "still_sequence": said.still_sequence,
                        "missing_stills": said.missing_stills,
                        "delay_p50_ms": round(10 * said.delay_p50_ms),
                    }
                )
                continue
            steps.append(
                {kind: number, "at_ms": at_ms} | ({} if delay_ms is None else {"delay_ms": delay_ms})
            )
            item = Received("", b"", b"", "", at_ns)
            if kind == "base":
                captured_ns = at_ns - round(1_000_000 * (delay_ms or 0.0))
                counted.base(replace(BASE, sequence=number, capture_ns=captured_ns), item)
            elif kind == "still":
                counted.still(replace(ROI, sequence=number), item)
            else:
                header = replace(BACKLOG, session_id=INFO.session_id, number=number)
                counted.backlog(header, item, delivered=True)
        yield {"session": name, "steps": steps}


def backlog_dialogues() -> Iterator[dict[str, Any]]:
    """Chunks in order, each with what the next report says; or what became of the object that was complete."""
    for name, events in _DIALOGUES:
        assembly, whole = BacklogAssembly(), None
        steps: list[dict[str, Any]] = []
        for event in events:
            if isinstance(event, bool):
                assert whole is not None
                assembly.settle(whole, usable=event)
                steps.append({"usable": event})
            else:
                which, start, end, total = event
                session_id, kind, number = _OBJECTS[which]
                header = BacklogHeader(
                    session_id=session_id,
                    kind=kind,
                    number=number,
                    offset=start,
                    total_bytes=total,
                    send_ns=10**18,
                )
                payload = _DATA[start:end]
                steps.append({"hex": header.pack(payload).hex(), "payload": payload.hex()})
                try:
                    done = assembly.chunk(header, payload)
                except WireError:
                    steps[-1]["refused"] = True
                    continue
                if done is not None:
                    whole = header.key
                    steps[-1]["object"] = done.hex()
            (said,) = assembly.take_acknowledged_ranges(16)
            steps[-1]["acknowledged"] = [said.number, said.acknowledged_bytes]
        yield {"session": name, "steps": steps}


def still_sizes() -> Iterator[dict[str, Any]]:
    """A still whose header says where it is and how large it was coded: read or refused undecoded."""
    view = View(_SOURCE, (1000, 750), 0.25, (0.0, 0.0))
    for what, crop, size in _SIZES:
        parameters = ({} if "nobody" in what else {"ask": 1}) | (
            {} if size is None else {"w": size[0], "h": size[1]}
        )
        x1, y1, x2, y2 = map(float, crop)
        header = replace(
            ROI,
            crop_source_px=crop,
            box_source_px=(x1, y1, x2, y2),
            parameters=parameters,
            also=(),
            codec="jpeg",
        )
        try:
            becomes: dict[str, Any] = {"size": coded_size(header, view=view), "becomes": "read"}
        except StillError:
            becomes = {"becomes": "refused"}
        yield {"what": what, "header": header.pack(b"a still").hex(), "source_size": _SOURCE, **becomes}
