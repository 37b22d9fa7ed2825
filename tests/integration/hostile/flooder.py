"""A second publisher on an edge's keys that says valid things as fast as it can, in a process of its own.

    python flooder.py KIND HEARS SAYS SECONDS

It listens to edge ``uav-1`` first, so that what it says is of the session that runs. Prints how much it said.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import zenoh

sys.path.insert(0, str(Path(__file__).parents[2] / "support"))

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import (
    BacklogHeader,
    BacklogKind,
    BaseHeader,
    ControlRequest,
    Feedback,
    RoiHeader,
    Status,
    TrackStep,
)
from programs.outsider import Message, Tap, joined

Said = tuple[Channel, bytes, bytes | None]


def copies(heard: dict[Channel, list[Message]]) -> Iterator[Said]:
    rows = [row for row in (Channel.BASE, Channel.ROI, Channel.TRACKS, Channel.STATUS) if heard[row]]
    for number in count():
        row = rows[number % len(rows)]
        message = heard[row][number // len(rows) % len(heard[row])]
        yield row, message.payload, message.attachment or None


def ahead(heard: dict[Channel, list[Message]]) -> Iterator[Said]:
    """The session carried on in its own name: numbers that nobody has used yet, each a little further."""
    pictures, stills = heard[Channel.BASE][-8:], heard[Channel.ROI][-8:]
    for number in count(1):
        message = pictures[number % len(pictures)]
        header = BaseHeader.parse(message.attachment, message.payload)
        lie = replace(header, sequence=header.sequence + number, frame_index=header.frame_index + number)
        yield Channel.BASE, message.payload, lie.pack(message.payload)
        if stills:
            message = stills[number % len(stills)]
            still = RoiHeader.parse(message.attachment, message.payload)
            lie_too = replace(still, sequence=still.sequence + 1000 + number)
            yield Channel.ROI, message.payload, lie_too.pack(message.payload)


def statuses(heard: dict[Channel, list[Message]]) -> Iterator[Said]:
    status = Status.parse(heard[Channel.STATUS][-1].payload)
    steps = [TrackStep.parse(one.payload) for one in heard[Channel.TRACKS][-1:]]
    for number in count(1):
        yield Channel.STATUS, replace(status, sequence=status.sequence + number).pack(), None
        for step in steps:
            further: dict[str, Any] = {
                "sequence": step.sequence + number,
                "frame_index": step.frame_index + number,
            }
            yield Channel.TRACKS, replace(step, **further).pack(), None


def past(heard: dict[Channel, list[Message]]) -> Iterator[Said]:
    """First pieces of large objects, none of which ever gets its second."""
    header = BaseHeader.parse(heard[Channel.BASE][-1].attachment, heard[Channel.BASE][-1].payload)
    payload = bytes(60_000)
    for number in count():
        piece = BacklogHeader(
            session_id=header.session_id,
            kind=BacklogKind.STILL if number % 2 else BacklogKind.BASE,
            number=number,
            offset=0,
            total_bytes=4_000_000,
            send_ns=header.send_ns,
        )
        yield Channel.BACKLOG, payload, piece.pack(payload)


def reports(heard: dict[Channel, list[Message]]) -> Iterator[Said]:
    """Receiver reports in a real ground's name, and in names that nobody has."""
    real = Feedback.parse(heard[Channel.FEEDBACK][-1].payload)
    for number in count(1):
        receiver = real.receiver_id if number % 2 else number
        yield (
            Channel.FEEDBACK,
            replace(real, sequence=real.sequence + number, receiver_id=receiver).pack(),
            None,
        )


KINDS: dict[str, tuple[Callable[[dict[Channel, list[Message]]], Iterator[Said]], tuple[Channel, ...]]] = {
    "copies": (copies, (Channel.BASE, Channel.ROI, Channel.STATUS)),
    "ahead": (ahead, (Channel.BASE, Channel.ROI)),
    "statuses": (statuses, (Channel.STATUS,)),
    "backlog": (past, (Channel.BASE,)),
    "reports": (reports, (Channel.FEEDBACK,)),
}
"""By kind: what is said, and the rows that have to be heard before."""
KEYS = EdgeKeys("uav-1")


def main() -> None:
    kind, hears, says, seconds = sys.argv[1:]
    with joined(hears) as ears, joined(says) as mouth:
        said = ask(mouth, float(seconds)) if kind == "questions" else say(kind, ears, mouth, float(seconds))
    print(json.dumps(said))


def listened(session: zenoh.Session, needed: tuple[Channel, ...]) -> dict[Channel, list[Message]]:
    tap, end_s = Tap(session, f"hvt/{KEYS.edge}/**"), time.monotonic() + 40
    while time.monotonic() < end_s:
        heard: dict[Channel, list[Message]] = {row: [] for row in Channel}
        for message in tap.messages:
            heard[Channel(message.key.rpartition("/")[2])].append(message)
        if all(len(heard[row]) >= (12 if row is Channel.BASE else 1) for row in needed):
            return heard
        time.sleep(0.1)
    sys.exit(f"nothing came on {', '.join(row for row in needed if not heard[row])}")


def say(kind: str, ears: zenoh.Session, mouth: zenoh.Session, seconds: float) -> dict[str, float]:
    flood, needed = KINDS[kind]
    heard = listened(ears, needed)
    end_s, said, size_bytes = time.monotonic() + seconds, 0, 0
    for row, payload, attachment in flood(heard):
        mouth.put(KEYS[row], payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)
        said += 1
        size_bytes += len(payload)
        if said % 16 == 0 and time.monotonic() > end_s:
            break
    return {"said": said, "bytes": size_bytes}


def ask(session: zenoh.Session, seconds: float) -> dict[str, float]:
    """Questions on control that the edge understands: keyframes, and stills of any place."""
    questions = [
        ControlRequest(session_id=0, command=command, arguments=arguments).pack()
        for command, arguments in (
            ("keyframe", {}),
            ("still", {"x": 40, "y": 40, "w": 200, "h": 120, "quality": 95}),
            ("tracks", {}),
        )
    ]
    end_s, said, answered = time.monotonic() + seconds, 0, 0

    def heard(_reply: zenoh.Reply) -> None:
        nonlocal answered
        answered += 1

    while time.monotonic() < end_s:
        session.get(KEYS[Channel.CONTROL], heard, payload=questions[said % len(questions)], timeout=1.0)
        said += 1
    time.sleep(1.2)
    return {"said": said, "answered": answered}


if __name__ == "__main__":
    main()
