"""What an edge answers, without a link."""

from __future__ import annotations

import zlib
from types import SimpleNamespace
from unittest.mock import MagicMock

import msgpack

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import WIRE_VERSION, Feedback, Message
from hvt_edge.link import publisher
from rigs.messages import ANSWER, FEEDBACK, INFO_REQUEST, REQUEST


def of_version(version: int, message: Message) -> bytes:
    """The message as a ground of another version would have sealed it."""
    body = msgpack.packb([version, *msgpack.unpackb(message.pack())[1:-1], 2**32 - 1])[:-5]
    return body + b"\xce" + zlib.crc32(body).to_bytes(4, "big")


def test_a_ground_of_another_version_commands_nothing(caplog, monkeypatch):
    """A budget that a ground of last year set would be taken, and its answer not understood."""
    reports: list[Feedback] = []
    requests: list[object] = []
    session, asked = MagicMock(), {}
    monkeypatch.setattr(
        publisher, "serve", lambda _session, channel, **told: asked.update({channel: told["answer"]})
    )
    listener = publisher.EdgeListener(
        session,
        EdgeKeys("uav-1"),
        publisher.Answers(
            info=lambda _received_ns: b"info",
            control=lambda _request: ANSWER,
            on_feedback=reports.append,
            on_info_request=requests.append,
        ),
        failures=MagicMock(),
        clock=lambda: 7,
    )
    report = session.declare_subscriber.call_args.args[1]
    for version, taken in ((WIRE_VERSION - 1, 0), (WIRE_VERSION + 1, 0), (WIRE_VERSION, 1)):
        assert bool(asked[Channel.CONTROL](of_version(version, REQUEST))) is bool(taken)
        assert asked[Channel.INFO](of_version(version, INFO_REQUEST)) == b"info", (
            "who asks is told the version"
        )
        sample = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda v=version: of_version(v, FEEDBACK)))
        report(sample)
        assert (len(reports), len(requests)) == (taken, taken)
    assert listener.unusable == 6
    said = (
        f"a ground speaks wire version {WIRE_VERSION - 1}, edge uav-1 reads {WIRE_VERSION}: update a ground"
    )
    assert caplog.messages == [said]
