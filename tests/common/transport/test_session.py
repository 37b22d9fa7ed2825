"""Sessions over real Zenoh on loopback."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
import zlib
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import msgpack
import pytest
import zenoh

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys, selector
from hvt_common.protocol.ledger import STANDARD_ENCODINGS
from hvt_common.protocol.messages import BaseHeader, Command, ControlAnswer, ControlRequest, Flags
from hvt_common.transport.inbox import Inbox, Received
from hvt_common.transport.session import (
    declare_publisher,
    loses_declarations,
    open_session,
    query,
    serve,
    subscribe,
)
from hvt_common.transport.zenoh_config import LinkSettings, configure, connect_endpoints
from programs.processes import eventually

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "wire.md"
KEYS = EdgeKeys("uav-1")
WILD = ("tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/0.0.0.0:7447", "tcp/0.0.0.0:7448", "tcp/[::]:7447")


@pytest.fixture
def endpoint(free_port):
    return f"tcp/127.0.0.1:{free_port}"


def ground(endpoint):
    return LinkSettings("ground", listen=(endpoint,))


def edge(endpoint):
    return LinkSettings("edge", connect=(endpoint,))


def test_messages_cross_with_attachment_and_encoding(endpoint):
    """Nothing would arrive, or without what HVT knows about it."""
    inbox = Inbox(capacity=8)
    with open_session(ground(endpoint)) as listener, open_session(edge(endpoint)) as connector:
        subscriber = subscribe(listener, selector(Channel.BASE, edges="uav-*"), put=inbox.put)
        publisher = declare_publisher(connector, Channel.BASE, keys=KEYS)
        other = declare_publisher(connector, Channel.BASE, keys=EdgeKeys("rover-1"))
        eventually(lambda: publisher.matching_status.matching)
        keyframe = bytes(range(256)) * 400
        publisher.put(keyframe, attachment=b"header")
        other.put(b"not asked for")
        publisher.put(b"second", attachment=b"")
        first, second = inbox.get(timeout_s=60), inbox.get(timeout_s=60)
        assert inbox.get(timeout_s=0.1) is None
        assert not other.matching_status.matching
        subscriber.undeclare()
    assert (first.key, first.payload, first.attachment) == ("hvt/uav-1/base", keyframe, b"header")
    assert first.encoding == "video/h265"
    assert (second.payload, second.attachment) == (b"second", b"")
    assert 0 <= second.received_ns - first.received_ns < 60_000_000_000


def test_the_edge_may_start_first(endpoint):
    """Whoever starts the drone before the ground station would have to start it again."""
    with open_session(edge(endpoint)) as connector:
        publisher = declare_publisher(connector, Channel.BASE, keys=KEYS)
        publisher.put(b"nobody hears this")
        inbox = Inbox(capacity=8)
        for _ in range(2):  # and the ground may come and go
            with open_session(ground(endpoint)) as listener:
                subscriber = subscribe(listener, selector(Channel.BASE), put=inbox.put)
                eventually(lambda: publisher.matching_status.matching)
                publisher.put(b"heard")
                assert inbox.get(timeout_s=60).payload == b"heard"
                subscriber.undeclare()
            eventually(lambda: not publisher.matching_status.matching)


def test_questions_are_answered_and_silence_ends(endpoint):
    """A ground that joins late would wait for ever for an edge that is not there."""
    with open_session(ground(endpoint)) as listener, open_session(edge(endpoint)) as connector:
        answers = {b"size?": b"1280x720"}
        queryable = serve(connector, Channel.INFO, keys=KEYS, answer=answers.get)
        eventually(
            lambda: query(listener, Channel.INFO, keys=KEYS, question=b"size?", timeout_s=1) == [b"1280x720"]
        )
        assert query(listener, Channel.INFO, keys=KEYS, question=b"other?", timeout_s=1) == []
        assert query(listener, Channel.CONTROL, keys=KEYS, question=b"size?", timeout_s=1) == []
        queryable.undeclare()


def test_a_full_inbox_drops_what_comes():
    """Memory would grow with a slow consumer, or Zenoh's callback would stall every other stream."""
    inbox = Inbox(capacity=3)
    for number in range(5):
        inbox.put(Received(key="k", payload=b"", attachment=b"", encoding="", received_ns=number))
    assert (len(inbox), inbox.dropped) == (3, 2)
    assert [inbox.get(timeout_s=0).received_ns for _ in range(3)] == [0, 1, 2]
    assert inbox.get(timeout_s=0) is None


def test_closing_an_inbox_wakes_its_reader():
    """The process would hang at its end."""
    inbox = Inbox(capacity=3)
    got = []
    reader = threading.Thread(target=lambda: got.append(inbox.get(timeout_s=60)))
    reader.start()
    inbox.close()
    reader.join(60)
    assert got == [None]


@pytest.mark.parametrize(
    ("link", "told", "listen"),
    [
        (
            {"role": "edge", "connect": ("tcp/192.0.2.1:7447",)},
            # Else byte counts lie, strangers find the session, and a full TLS link hides seconds of video.
            {
                "transport/shared_memory/enabled": False,
                "scouting/multicast/enabled": False,
                "scouting/gossip/enabled": False,
                "listen/endpoints": [],
                **{f"transport/link/{protocol}/so_sndbuf": 65536 for protocol in ("tcp", "tls")},
            },
            (),
        ),
        # The two commands without options find each other.
        ({"role": "ground"}, {"connect/endpoints": []}, ("tcp/127.0.0.1:7447",)),
        ({"role": "edge"}, {"connect/endpoints": ["tcp/127.0.0.1:7447"]}, ()),
        # A port in use would be waited for that this very program holds, and a second link to one place be missed.
        (
            {"role": "ground", "listen": WILD, "connect": ("tcp/h:1",) * 2, "insecure": True},
            {"connect/endpoints": ["tcp/h:1"]},
            WILD[1:4],
        ),
        # Zenoh binds the address first, and Linux refuses one of which it does not know the interface.
        *(
            (
                {"role": "ground", "listen": (f"udp/[fe80::1%{given}]:7447",), "insecure": True},
                {"listen/endpoints": [f"udp/[fe80::1{zenohs}"]},
                (f"udp/[fe80::1%{given}]:7447",),
            )
            for given, zenohs in (("lo", "%1]:7447"), ("no-such-if", "]:7447#iface=no-such-if"))
        ),
    ],
)
def test_what_zenoh_is_told(link, told, listen):
    """It would take its own defaults: open to everybody, and late."""
    config, listens = configure(LinkSettings(**link))
    assert {path: json.loads(config.get_json(path)) for path in told} == told
    assert listens == listen


def test_the_users_file_goes_before_our_defaults_and_after_our_arguments(tmp_path):
    """A tuned link would run with other settings than its file says."""
    path = tmp_path / "zenoh.json5"
    path.write_text(
        """{ // comments are fine
          listen: { endpoints: ["tcp/127.0.0.1:7001"] },
          connect: { endpoints: ["tcp/192.0.2.9:7002"] },
          transport: { link: { tx: { lease: 1234, queue: { size: { data_high: 9 } } } } },
        }"""
    )
    config, listen = configure(LinkSettings("edge", connect=("tcp/192.0.2.1:7447",), zenoh_config=path))
    told = {
        "connect/endpoints": ["tcp/192.0.2.1:7447"],
        "transport/link/tx/lease": 1234,
        **{
            f"transport/link/tx/queue/size/{row}": size for row, size in (("data_high", 9), ("background", 1))
        },
        "transport/shared_memory/enabled": False,
    }
    assert {name: json.loads(config.get_json(name)) for name in told} == told
    assert listen == ("tcp/127.0.0.1:7001",)


def _links(settings):
    config, _ = configure(settings)
    return json.loads(config.get_json("connect/endpoints")), config.get_json("transport/unicast/max_links")


def test_two_links_by_priority_are_asked_for_only_where_wanted(tmp_path):
    """A second connection costs a handshake and keep-alives that the budget does not count."""
    tcp, tls = "tcp/192.0.2.1:7447", "tls/192.0.2.1:7448"
    there = (tcp, f"{tls}#so_sndbuf=1", "tcp/192.0.2.1:1?prio=2-7", "udp/192.0.2.1:1")
    split = [f"{tcp}?prio={one}" for one in ("1-3", "4-7")]
    split += [*(f"{tls}?prio={one}#so_sndbuf=1" for one in ("1-3", "4-7")), *there[2:]]
    path = tmp_path / "two.json5"
    path.write_text("{ transport: { unicast: { max_links: 2 } } }")
    assert _links(LinkSettings("edge", connect=there)) == (list(there), "1")
    assert _links(LinkSettings("edge", connect=there, links=2)) == (split, "2")
    assert _links(LinkSettings("client", connect=there))[0] == list(there)
    assert _links(LinkSettings("edge", connect=there, zenoh_config=path)) == (split, "2")
    assert _links(LinkSettings("ground"))[1] == "2", "who listens takes two from whoever asks"


@pytest.mark.parametrize(
    ("given", "zenohs"),
    [
        ("tcp/[fe80::1%eth0]:7447", "tcp/[fe80::1]:7447#iface=eth0"),
        ("tls/[FE80::1%br-lan.4]:1?prio=1-3#dscp=0x88", "tls/[FE80::1]:1?prio=1-3#dscp=0x88;iface=br-lan.4"),
        ("tcp/[fe80::1%3]:7447", "tcp/[fe80::1%3]:7447"),
    ],
)
def test_a_link_local_endpoint_names_its_interface(given, zenohs):
    """Zenoh looks for a machine of that name for ever: the edge never has a link."""
    config, _ = configure(LinkSettings("edge", connect=(given,)))
    assert json.loads(config.get_json("connect/endpoints")) == [zenohs]
    # Whoever looks why there is no link has to go the same way.
    assert connect_endpoints(config)[0].partition("#")[0] == given.partition("#")[0]


def test_two_links_to_one_port_carry_all_rows_each_by_its_priority(endpoint):
    """Answers would wait behind pictures although two links were asked for, or a row would be lost between them."""
    with open_session(ground(endpoint)) as listener:
        inbox = Inbox(capacity=64)
        subscriber = subscribe(listener, "hvt/uav-1/*", put=inbox.put)
        with open_session(LinkSettings("edge", connect=(endpoint,), links=2)) as connector:
            queryable = serve(connector, Channel.INFO, keys=KEYS, answer=lambda question: question)
            eventually(lambda: all(len(session.info.links()) == 2 for session in (connector, listener)))
            for session in (connector, listener):
                assert sorted(one.priorities for one in session.info.links()) == [(1, 3), (4, 7)]
            rows = (Channel.BASE, Channel.ROI, Channel.TRACKS, Channel.BACKLOG, Channel.STATUS)
            publishers = {row: declare_publisher(connector, row, keys=KEYS) for row in rows}
            eventually(lambda: all(one.matching_status.matching for one in publishers.values()))
            for row, publisher in publishers.items():
                publisher.put(str(row).encode())
            came = {inbox.get(timeout_s=60).payload.decode() for _ in rows}
            assert came == {str(row) for row in rows}
            assert query(listener, Channel.INFO, keys=KEYS, question=b"who?", timeout_s=5) == [b"who?"]
            queryable.undeclare()
        subscriber.undeclare()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{\n mode: "peer",\n foo: ]\n}', r":3 is not JSON5: Unexpected .\]. at column 7$"),
        ("{", r"(:\d+)? is not JSON5: "),
        ("[]", r" is a list: give Zenoh's settings, an object in braces$"),
        ("{\n transport: {\n  unicast: { max_linkss: 2 } } }", r":3 is not .*: unknown field `max_linkss`$"),
        ('{\n mode: "pear" }', r":2 is not accepted by Zenoh: unknown variant `pear`$"),
        ('{ listen: { endpoints: ["tcp"] } }', r" is not accepted by Zenoh: .*Endpoints must be"),
        ("[" * 100_000, r" is not JSON5: "),
        ("\xff\xfe\0", "not UTF-8 text"),
    ],
)
def test_a_broken_file_is_one_sentence_with_its_line(tmp_path, text, said):
    """The user would search a hundred lines for a missing brace."""
    path = tmp_path / "zenoh.json5"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(UserError, match=rf"zenoh\.json5.*{said}") as caught:
        configure(LinkSettings("edge", zenoh_config=path))
    assert "\n" not in str(caught.value)
    assert ".rs:" not in str(caught.value)


def test_a_file_that_cannot_be_read_is_one_sentence(tmp_path):
    """The user would see a traceback for a typo in a name."""
    for path, said in (
        (tmp_path / "nowhere.json5", r"nowhere\.json5 cannot be .*No such file"),
        (tmp_path, "Is a d"),
    ):
        with pytest.raises(UserError, match=f"--zenoh-config .*{said}"):
            configure(LinkSettings("edge", zenoh_config=path))


def test_an_endpoint_that_is_none_is_one_sentence():
    """Zenoh would say it in terms of its own source, or not at all; a valid one would be refused."""
    local = "tcp/127.0.0.1"
    for wrong in (
        *("", local, "tcp/a b:1", *(f"{local}:{port}" for port in ("0", "65536", "x", "1\n"))),
        *["tcp", "127.0.0.1:7447", "tcp/:7447", "http/127.0.0.1:80", "tcp//127.0.0.1:7447"],
    ):
        for settings in (LinkSettings("edge", connect=(wrong,)), LinkSettings("ground", listen=(wrong,))):
            with pytest.raises(UserError, match="PROTOCOL/HOST:PORT is accepted"):
                configure(settings)
    for right in (
        *("tcp/[::1]:7447", "udp/localhost:1?rel=1", "tls/127.0.0.1:65535"),
        "tcp/127.9.9.9:7447#so_sndbuf=8192",
    ):
        assert configure(LinkSettings("ground", listen=(right,)))[1] == (right,)


@pytest.mark.parametrize(
    "open_door", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/192.0.2.7:7447", "tls/drone.example:7447"]
)
def test_listening_beyond_loopback_needs_keys_or_consent(open_door, tmp_path):
    """Anybody on the network could watch the video and command the edge."""
    with pytest.raises(UserError, match=r"without keys .* accept it with --insecure"):
        configure(LinkSettings("ground", listen=(open_door,)))
    assert configure(LinkSettings("ground", listen=(open_door,), insecure=True))[1] == (open_door,)
    path = tmp_path / "file.json5"
    path.write_text(f'{{ listen: {{ endpoints: {{ peer: ["{open_door}"] }} }} }}')
    with pytest.raises(UserError, match="without keys"):
        configure(LinkSettings("ground", zenoh_config=path))
    path.write_text("{ transport: { link: { tls: { enable_mtls: true } } } }")
    settings = LinkSettings("ground", listen=(open_door,), zenoh_config=path)
    if open_door.startswith("tls/"):
        assert configure(settings)[1] == (open_door,)
    else:
        with pytest.raises(UserError, match="without keys"):
            configure(settings)


def test_an_address_that_cannot_be_had_is_one_sentence():
    """Zenoh's own error names lines of Rust."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        here = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        for endpoint, why in (
            (here, "the port is in use;"),
            ("tcp/192.0.2.1:7447", "this machine has no such address$"),
            ("tcp/0.0.0.0:7447#iface=none-9", "this machine has no such interface$"),
        ):
            settings = LinkSettings("ground", listen=(endpoint,), insecure=True)
            with pytest.raises(UserError, match=f"^cannot listen on {endpoint}: {why}"):
                open_session(settings).__enter__()


LISTENER = """
    import signal, sys, time
    signal.signal(signal.SIGINT, signal.default_int_handler)  # who starts in the background may ignore it
    from hvt_common.transport.inbox import Inbox
    from hvt_common.transport.session import open_session, subscribe
    from hvt_common.transport.zenoh_config import LinkSettings
    from hvt_common.protocol.channels import *
    with open_session(LinkSettings("ground", listen=(sys.argv[1],))) as session:
        inbox = Inbox(capacity=8)
        subscriber = subscribe(session, selector(Channel.BASE), put=inbox.put)
        print("up", flush=True)
        time.sleep(120)
"""
STUCK_SENDER = """
    import sys, threading, time
    from hvt_common.transport.session import declare_publisher, open_session
    from hvt_common.transport.zenoh_config import LinkSettings
    from hvt_common.protocol.channels import *
    with open_session(LinkSettings("edge", connect=(sys.argv[1],))) as session:
        publisher = declare_publisher(session, Channel.BASE, keys=EdgeKeys("uav-1"))
        while not publisher.matching_status.matching:
            time.sleep(0.01)
        print("up", flush=True)
        sys.stdin.readline()
        count = 0
        def send():
            global count
            while True:
                publisher.put(bytes(5000))
                count += 1
        threading.Thread(target=send, daemon=True).start()
        last = -1
        while count != last:  # until put blocks
            last = count
            time.sleep(0.2)
        print("stuck", flush=True)
        if sys.argv[2] == "raise":
            raise RuntimeError("on purpose")
    print("closed", flush=True)
"""


def start(code, *arguments):
    """A process of its own, as the two sides are."""
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code), *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.integration
@pytest.mark.parametrize("way", ["leave", "raise"])
def test_leaving_a_dead_link_ends_the_process(endpoint, way):
    """Ctrl-C in the field would hang for as long as the link is stuck: Zenoh alone takes 10 s and then raises."""
    listener = start(LISTENER, endpoint)
    try:
        assert listener.stdout.readline() == "up\n"
        sender = start(STUCK_SENDER, endpoint, way)
        assert sender.stdout.readline() == "up\n"
        os.kill(listener.pid, signal.SIGSTOP)
        sender.stdin.write("go\n")
        sender.stdin.flush()
        out, err = sender.communicate()
    finally:
        listener.kill()
        listener.communicate()
    if way == "raise":
        assert sender.returncode == 1
        assert err.rstrip().endswith("RuntimeError: on purpose")
    else:
        assert (sender.returncode, out.split()) == (0, ["stuck", "closed"])


@pytest.mark.integration
def test_interrupting_a_subscriber_ends_it(endpoint):
    """A callback subscriber that is not closed hangs at exit."""
    listener = start(LISTENER, endpoint)
    assert listener.stdout.readline() == "up\n"
    time.sleep(0.5)  # until it sleeps: in a finaliser Python would drop the interrupt
    listener.send_signal(signal.SIGINT)
    _, err = listener.communicate()
    assert err.rstrip().endswith("KeyboardInterrupt")


def longer(header, payload):
    """The header as a later minor version may send it: MessagePack's long array, with fields that nobody knows."""
    body = msgpack.packb([*msgpack.unpackb(header)[:-1], *range(10), 2**32 - 1])[:-5]
    return body + b"\xce" + zlib.crc32(body, zlib.crc32(payload)).to_bytes(4, "big")


@pytest.mark.integration
@pytest.mark.parametrize("way", ["connect", "listen"])
def test_the_subscriber_of_the_document_writes_the_video(endpoint, tmp_path, way):
    """Whoever copies it would get nothing, or garbage after the first loss."""
    code = re.search(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)[1]
    asked = threading.Event()

    def answer(question):
        if ControlRequest.parse(question).command == Command.KEYFRAME:
            asked.set()
        return ControlAnswer(
            session_id=7, accepted=True, reason="", still_request=-1, frame_index=-1, tracks=()
        ).pack()

    other: dict[str, Any] = {{"connect": "listen", "listen": "connect"}[way]: (endpoint,)}
    with open_session(LinkSettings("edge", **other)) as session:
        publisher = declare_publisher(session, Channel.BASE, keys=KEYS)
        queryable = serve(session, Channel.CONTROL, keys=KEYS, answer=answer)
        reader = start(code, way, endpoint, "uav-1", str(tmp_path / "out.hevc"))
        try:
            eventually(lambda: publisher.matching_status.matching)
            # Sequence 1 comes without a keyframe before it, 4 is lost, 5 depends on it, 8 is corrupt, 3 and 2 repeat.
            sent = [(1, 0, 0), (2, 1, 1), (3, 0, 1), (3, 0, 0), (5, 0, 0), (2, 1, 0), (6, 1, 1), (7, 0, 1)]
            for sequence, keyframe, kept in [*sent, (8, 1, 0), (9, 0, 0), (10, 1, 1)]:
                payload = f"{'+' if kept else '-'}{sequence}".encode()
                times = {"capture_ns": time.time_ns(), "send_delay_ns": 0}
                header = BaseHeader(
                    session_id=7,
                    sequence=sequence,
                    frame_index=sequence,
                    flags=Flags.KEYFRAME if keyframe else 0,
                    **times,
                )
                header = longer(header.pack(payload), payload) if sequence == 7 else header.pack(payload)
                publisher.put(b"-x" if sequence == 8 else payload, attachment=header)
            eventually(lambda: (tmp_path / "out.hevc").read_bytes().endswith(b"+10"))
            assert asked.wait(60)
        finally:
            reader.kill()
            _, err = reader.communicate()
        queryable.undeclare()
    assert (tmp_path / "out.hevc").read_bytes() == b"+2+3+6+7+10", err


def test_zenoh_still_calls_the_encodings_as_the_ledger_does():
    """The overhead formula gives 1 byte to encodings that Zenoh has a number for."""
    known = {str(value) for value in vars(zenoh.Encoding).values() if isinstance(value, zenoh.Encoding)}
    assert known >= STANDARD_ENCODINGS


def test_a_question_that_is_lost_is_asked_once_more(monkeypatch):
    """Over UDP one lost datagram would be told as a right that is missing, or as an edge that has gone."""
    asked_s: list[float] = []
    there = True

    def later(*_args, timeout_s, on_answer, on_end, **_named):
        asked_s.append(timeout_s)
        if not there:
            on_end()
        elif len(asked_s) == 2:
            on_answer(b"yes")

    monkeypatch.setattr("hvt_common.transport.session.query_later", later)
    told: dict[str, Any] = {"keys": EdgeKeys("uav-1"), "question": b"", "timeout_s": 0.02}
    assert query(None, Channel.CONTROL, **told) == [b"yes"]
    assert asked_s == [0.02, 0.01]
    there = False
    assert query(None, Channel.CONTROL, **told) == []
    assert len(asked_s) == 3, "nobody is there: who waits is told at once"


def test_who_stays_silent_is_not_waited_for_once_another_has_answered(monkeypatch):
    """One that went dark, beside its restarted self, cost every command a second a question."""
    waits_s: list[float] = []
    rounds = [[b"yes", b"no"], [], [b"no", b"yes"], [b"no"], [b"no", b"yes", b"no"]]

    class Answers(SimpleQueue):
        def get(self, timeout: float) -> bytes | None:
            waits_s.append(timeout)
            return super().get(block=False)

    def later(*_args, on_answer, **_named):
        for answer in rounds.pop(0):
            on_answer(answer)

    monkeypatch.setattr("hvt_common.transport.session.query_later", later)
    monkeypatch.setattr("hvt_common.transport.session.SimpleQueue", Answers)
    told: dict[str, Any] = {"keys": EdgeKeys("uav-1"), "question": b"", "timeout_s": 600.0}
    assert query(None, Channel.INFO, **told) == [b"yes", b"no"]
    assert waits_s[0] > 200
    assert max(waits_s[1:]) <= 0.3
    assert query(None, Channel.INFO, **told) == [b"no", b"yes"], "both that came late"
    assert query(None, Channel.CONTROL, **told, is_last=b"yes".__eq__) == [b"no", b"no", b"yes"]


def test_where_a_declaration_may_be_lost_it_is_made_again(tmp_path):
    """Rights name whole keys: over TLS an edge would withdraw what its grounds may use for what they may not.

    Behind a router the next link may be UDP, whatever this one is.
    """
    file = tmp_path / "link.json5"
    file.write_text('{connect: {endpoints: ["udp/10.0.0.1:7447"]}}')
    for routers, link, loses in (
        ([], {"connect": ("udp/127.0.0.1:7447",)}, True),
        ([], {"listen": ("udp/127.0.0.1:7447",)}, True),
        ([], {"zenoh_config": file}, True),
        ([], {}, False),
        ([7], {}, True),
        ([7], {"connect": ("tls/127.0.0.1:7447",)}, False),
        ([7], {"connect": ("quic/127.0.0.1:7447",)}, False),
    ):
        session = SimpleNamespace(info=SimpleNamespace(routers_zid=lambda routers=routers: routers))
        assert loses_declarations(LinkSettings("edge", **link), session)() is loses, link
