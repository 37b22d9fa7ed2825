"""A third party that may publish on an edge's keys, and sends what nobody should have to read."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import pytest
import zenoh

from hvt_common.protocol.messages import MAX_PAYLOAD_BYTES, BaseHeader, ControlAnswer, ControlRequest, Flags
from programs.outsider import Message, Tap, answer, joined
from programs.processes import Link, eventually
from programs.rrd import Recording

pytestmark = [pytest.mark.integration, pytest.mark.realtime]

ROUNDS = 25
"""How often each kind of bad message is sent, a tenth of a second apart."""


def asked(session: zenoh.Session, request: ControlRequest) -> ControlAnswer:
    """The edge's answer; after a flood of questions it may take a while to come to this one."""
    for _ in range(10):
        time.sleep(1.1)  # beyond the second in which so many questions are served at most
        heard = answer(session, "hvt/uav-1/control", request.pack())
        if heard is not None:
            return ControlAnswer.parse(heard)
    raise AssertionError(f"no answer to {request}")


@dataclass
class Attack:
    """What was sent, and how both sides came through it."""

    bad_to_ground: int
    """Messages that no side should be able to use."""
    replayed: int
    bad_to_edge: int
    refusals: list[ControlAnswer]
    edge: dict[str, Any]
    ground: dict[str, Any]
    recording: Recording
    ground_said: str
    edge_said: str


def flipped(data: bytes, rng: Random) -> bytes:
    """The same with one bit the other way."""
    at = rng.randrange(len(data))
    return data[:at] + bytes((data[at] ^ 1 << rng.randrange(8),)) + data[at + 1 :]


def spoilt(message: Message, rng: Random) -> list[tuple[bytes, bytes]]:
    """(payload, attachment) of a real message, damaged in each way there is."""
    payload, attachment = message.payload, message.attachment
    return [
        (flipped(payload, rng), attachment),
        (payload, flipped(attachment, rng)),
        (payload[: rng.randrange(len(payload))], attachment),
        (payload, attachment[: rng.randrange(1, len(attachment))]),
        (payload, b""),
        (rng.randbytes(rng.randrange(2000)), rng.randbytes(rng.randrange(1, 80))),
        (payload, attachment + bytes(10_000)),
    ]


class Mouth:
    """Publishes for the third party, and counts."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self.said = 0

    def say(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        """One message, which waits for room rather than be dropped."""
        self._session.put(
            key, payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK
        )
        self.said += 1


def attack_ground(session: zenoh.Session, ears: Tap, rng: Random) -> tuple[int, int]:
    """Bad and replayed messages on all keys the ground listens to; how many of each."""
    bad, replays, other = Mouth(session), Mouth(session), Mouth(session)
    for _ in range(ROUNDS):
        heard = ears.messages
        for row in ("base", "roi"):
            messages = [message for message in heard if message.key == f"hvt/uav-1/{row}"]
            if not messages:
                continue
            victim = rng.choice(messages[-20:])
            for payload, attachment in spoilt(victim, rng):
                bad.say(victim.key, payload, attachment)
            other.say(victim.key, victim.payload, victim.attachment)
            replays.said += row == "base"
        bad.say("hvt/uav-1/status", rng.randbytes(300))
        bad.say("hvt/uav-1/status", b"")
        for payload, attachment in forged(messages_of(heard, "base")[-1]):
            other.say("hvt/uav-1/base", payload, attachment)
        other.say("hvt/UAV_1/base", b"not a key of ours")
        other.say("hvt/uav-1/nonsense", b"nor this")
        time.sleep(0.1)
    large = messages_of(ears.messages, "base")[-1]
    bad.say(large.key, bytes(MAX_PAYLOAD_BYTES + 1), large.attachment)
    other.say(large.key, bytes(3 * MAX_PAYLOAD_BYTES), large.attachment)
    return bad.said, replays.said


def messages_of(heard: list[Message], row: str) -> list[Message]:
    """Those of one row."""
    return [message for message in heard if message.key == f"hvt/uav-1/{row}"]


def forged(message: Message) -> Iterator[tuple[bytes, bytes]]:
    """Well-formed messages with numbers that cannot be true: an invented session, a sequence from far ahead."""
    header = BaseHeader.parse(message.attachment, message.payload)
    keyframe = header.flags | Flags.KEYFRAME
    for lie in (
        replace(header, session_id=header.session_id ^ 1, flags=keyframe),
        replace(header, sequence=header.sequence + 2**30, flags=keyframe),
    ):
        yield message.payload, lie.pack(message.payload)


def attack_edge(session: zenoh.Session, ears: Tap, rng: Random) -> int:
    """Bad feedback and bad questions; how many."""
    bad = Mouth(session)
    for _ in range(ROUNDS):
        reports = messages_of(ears.messages, "feedback")
        if reports:
            real = rng.choice(reports).payload
            session.put("hvt/uav-1/feedback", real)
            bad.say("hvt/uav-1/feedback", flipped(real, rng))
            bad.say("hvt/uav-1/feedback", real[: rng.randrange(len(real))])
        bad.say("hvt/uav-1/feedback", rng.randbytes(200))
        bad.say("hvt/uav-1/feedback", bytes(100_000))
        session.get("hvt/uav-1/control", lambda _reply: None, payload=rng.randbytes(50), timeout=1.0)
        session.get("hvt/uav-1/info", lambda _reply: None, payload=rng.randbytes(5000), timeout=1.0)
        bad.said += 2
        time.sleep(0.1)
    return bad.said


@pytest.fixture(scope="module")
def attack(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Attack:
    """A run in real time, with a third party that listens to the edge and talks to both."""
    folder, rng = tmp_path_factory.mktemp("attack"), Random(3)
    with Link(folder) as link:
        ground = link.ground("--record", "flight.rrd", "--once")
        edge = link.edge(
            *("--source", str(scene), "--source-fps", "10", "--fps", "10", "--size", "640x360"),
            *("--preset", "ultrafast", "--budget", "300kbps", "--edge-id", "uav-1", "--max-frames", "240"),
            *("--method", "M5", "--video-share", "0.6"),  # stills have their share, whatever they give
            *("--detector", "motion"),  # these are no objects that a network knows
            listens=True,
        )
        with joined(link.edge_endpoint) as to_edge, joined(link.ground_endpoint) as to_ground:
            ears = Tap(to_edge, "hvt/uav-1/**")
            reports = Tap(to_ground, "hvt/uav-1/feedback")
            eventually(lambda: messages_of(ears.messages, "roi"), what="stills come")
            eventually(lambda: messages_of(ears.messages, "base"), what="pictures come")
            bad_to_ground, replayed = attack_ground(to_ground, ears, rng)
            bad_to_edge = attack_edge(to_edge, reports, rng)
            refusals = [
                asked(to_edge, request)
                for request in (
                    ControlRequest(session_id=0, command="self-destruct", arguments={"now": 1}),
                    ControlRequest(session_id=12345, command="keyframe", arguments={}),
                )
            ]
            summaries = edge.finish(), ground.finish()
        return Attack(
            bad_to_ground,
            replayed,
            bad_to_edge,
            refusals,
            *summaries,
            recording=Recording(folder / "flight.rrd"),
            ground_said=ground.said,
            edge_said=edge.said,
        )


def test_the_ground_counts_bad_messages_and_loses_no_frame(attack):
    """Anybody on the link could blind the operator with one packet."""
    ground, edge = attack.ground, attack.edge
    assert attack.bad_to_ground > 10 * ROUNDS
    assert ground["unusable_messages"] == attack.bad_to_ground
    assert ground["duplicates"] == attack.replayed > 0
    assert ground["frames_decoded"] == ground["frames"] == edge["frames"] > 0
    assert ground["gaps"] == ground["lost"] == 0


def test_the_account_holds_none_of_it(attack):
    """The two ledgers would part, and the link be blamed."""
    for name in ("base_bytes", "roi_bytes", "meta_bytes", "overhead_bytes", "worst_window_bps"):
        assert attack.ground[name] == attack.edge[name], name
    assert attack.ground["stills"]["received"] == attack.edge["stills"]["sent"] > 0
    assert len(attack.recording.video()) == attack.edge["frames"]
    told = {text.split()[1] for _, _, text in attack.recording.events() if text.startswith("still #")}
    assert len(told) == attack.edge["stills"]["sent"]


def test_the_edge_counts_bad_messages_and_flies_on(attack):
    """Anybody on the link could stop the drone's video."""
    assert attack.edge["unusable_messages"] == attack.bad_to_edge > 2 * ROUNDS
    assert [answer.accepted for answer in attack.refusals] == [False, False]
    assert "self-destruct" in attack.refusals[0].reason
    assert "session" in attack.refusals[1].reason


def test_a_flood_does_not_fill_the_log(attack):
    """The one line that matters would scroll away."""
    for said in (attack.ground_said, attack.edge_said):
        assert "skipped" in said or "unusable" in said
        assert sum("message" in line for line in said.splitlines()) < 25
