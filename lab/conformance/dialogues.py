"""Vectors of a ground's results: reports, objects of the backlog from their chunks, sizes of stills."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.messages import BacklogHeader, BacklogKind, BaseHeader, Flags, WireError
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_common.values import View
from hvt_common.video.still_codecs import StillError
from hvt_ground.backlog.assembly import BacklogAssembly
from hvt_ground.link.reassemble import Arrival, Reassembler
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
    (
        "the total changes",
        ((7, 0, 15, 25), (7, 15, 20, 40), (7, 0, 20, 40), (7, 20, 25, 30), (7, 0, 30, 30), True),
    ),
    (
        "the total changes after the end",
        ((7, 0, 30, 30), True, (7, 0, 20, 40), (7, 20, 40, 40), True, (7, 0, 20, 30)),
    ),
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
    ("of another shape by just as much as may be, upright", (0, 0, 50, 100), (25, 52)),
)

_TRACES = (
    ("nothing yet", "report@0"),
    ("all arrives", "base0@0+20.5 still0@5 base1@40+21.5 report@47"),
    (
        "two stills are missing, one comes again, one with the backlog",
        "base0@0 still0@5 still3@9 report@10 stored2147483648@11 still1@15 report@20 stored2@30 report@40",
    ),
    (
        "a ground that comes later misses nothing that was before it",
        "base50@0 still40@5 report@10 still42@15 report@20",
    ),
    ("one that was there from the start does", "base0@0 still2@5 report@9"),
    ("a still is missed for six seconds", "still7@0 still9@100 report@6100 report@6101"),
    ("of many the newest are named", "still0@0 still100@5 report@6 still105@7 report@8"),
    (
        "the highest counts, and when it came",
        "base3@0 base5@10 base5@15 base4@20 still4@21 still3@22 report@30",
    ),
    (
        "the median of the delays since the last report",
        "base0@0+19.5 base1@1+4.5 base2@2+6.0 report@3 base3@4+5.0 base4@5+8.0 report@6 report@7",
    ),
)
"""The kind of message, its number, its arrival in ms, its delay."""
_OTHERS: Any = dict.fromkeys(("receiver_id", "sequence", "clock_offset_ns"), 0)
_OTHERS |= {"clock_error_ns": -1, "backlog": ()}
"""Fields of a report that others fill."""


_ORDERS = (
    ("all arrives", "0K 1 2 3K 4"),
    ("a reader that comes later", "7 8 9K 10"),
    ("one is lost", "0K 1 3 4 5K 6"),
    ("two are lost before a keyframe", "0K 3K 4"),
    ("some come twice", "0K 1 1 0K 2 3K 3K 4"),
    ("some come twice while a keyframe is waited for", "0K 1 3 0K 1 3 4K 5"),
    ("what was lost comes late", "0K 1 3 2 4 5K 6 4 7"),
    ("damage", "0K 1! 2 3K 4 5K! 6 7K 8"),
    ("the edge starts again", "0K 1 2 +0 +1K +2 3 0K +3"),
)
"""Numbers on ``base``, a second apart, so that nobody waits for missing ones: K a keyframe, ! damaged, + of the
next session."""


def base_orders() -> Iterator[dict[str, Any]]:
    """Messages of ``base`` in the order in which they come, each with whether a decoder gets it."""
    for name, script in _ORDERS:
        stream, steps, arrivals = Reassembler[int](), [], list[Arrival[int]]()
        for at, word in enumerate(script.split()):
            number = int(word.strip("+K!"))
            header = replace(
                BASE,
                session_id=_SESSION + word.count("+"),
                sequence=number,
                frame_index=2 * number,
                flags=64 + int(Flags.KEYFRAME) * word.count("K"),
            )
            data, payload = header.pack(_DATA[:4]), _DATA[word.count("!") : 4]
            steps.append({"hex": data.hex(), "payload": payload.hex(), "decode": False})
            arrivals += stream.overdue(now_ns=at * SECOND_NS)
            try:
                arrivals += stream.accept(BaseHeader.parse(data, payload), at, now_ns=at * SECOND_NS)
            except WireError:
                stream.corrupt()
        for one in arrivals:
            steps[one.message]["decode"] = one.verdict == "decode"
        yield {"session": name, "steps": steps}


def report_traces() -> Iterator[dict[str, Any]]:
    """Messages with their arrival, and the fields of the reports between."""
    for name, script in _TRACES:
        info = replace(INFO, pace="realtime" if "+" in script else "lockstep")  # in which no delay is known
        counted = Reception(info, clock=int, edge_clock=ClockOffset(), emit=lambda _event: None)
        steps: list[dict[str, Any]] = []
        for kind, number, at, delay in re.findall(r"([a-z]+)(\d*)@(\d+)\+?(\S*)", script):
            at_ms = int(at)
            at_ns = at_ms * 1_000_000
            if kind == "report":
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
            steps.append({kind: int(number), "at_ms": at_ms} | ({"delay_ms": float(delay)} if delay else {}))
            item = Received("", b"", b"", "", at_ns)
            if kind == "base":
                captured_ns = at_ns - round(1_000_000 * float(delay or 0))
                counted.base(replace(BASE, sequence=int(number), capture_ns=captured_ns), item)
            elif kind == "still":
                counted.still(replace(ROI, sequence=int(number)), item)
            else:
                header = replace(BACKLOG, session_id=INFO.session_id, number=int(number))
                counted.backlog(header, item, delivered=True)
        yield {"session": name, "steps": steps}


def backlog_dialogues() -> Iterator[dict[str, Any]]:
    """Chunks in order, each with the next report, or with the outcome of a complete object."""
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
        parameters = ({} if "nobody" in what else {"ask": 0}) | (
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
