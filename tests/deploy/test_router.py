"""deploy/router.py as a real process, with messages of two other sessions through it."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys, selector
from hvt_common.transport.session import declare_publisher, open_session, query, serve
from hvt_common.transport.zenoh_config import LinkSettings
from programs.processes import eventually, free_ports, router

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
KEYS = EdgeKeys("uav-1")

pytestmark = pytest.mark.integration


def _first(
    samples: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]], send: Callable[[], None]
) -> zenoh.Sample:
    """What comes when it is sent again and again, as a stream is.

    Once is not enough: a publisher is told that it is wanted before the routers have found the way for what it sends,
    and what is sent in between is lost.
    """
    came: list[zenoh.Sample] = []

    def tried() -> bool:
        send()
        time.sleep(0.1)
        if (sample := samples.try_recv()) is not None:
            came.append(sample)
        return bool(came)

    eventually(tried)
    return came[0]


def _client(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


@pytest.mark.parametrize("receiver", ["ground behind the router", "one that listens too", "client"])
def test_messages_questions_and_presence_pass(receiver: str) -> None:
    """Where both sides can only call out, the router is the link: all of the key table must get through it."""
    endpoint, own = (f"tcp/127.0.0.1:{port}" for port in free_ports(2))
    ground = LinkSettings(
        role="ground", connect=(endpoint,), listen=(own,) if receiver == "one that listens too" else ()
    )
    with ExitStack() as stack:
        stack.enter_context(router("--listen", endpoint))
        edge = stack.enter_context(open_session(LinkSettings(role="edge", connect=(endpoint,))))
        other = stack.enter_context(
            open_session(ground) if receiver != "client" else zenoh.open(_client(endpoint))
        )
        samples = other.declare_subscriber(selector(Channel.BASE))
        publisher = declare_publisher(edge, Channel.BASE, keys=KEYS)
        serve(edge, Channel.INFO, keys=KEYS, answer=lambda question: b"answer to " + question)
        token = edge.liveliness().declare_token(KEYS[Channel.ALIVE])
        eventually(lambda: publisher.matching_status.matching)
        unit = bytes(range(256)) * 120
        sample = _first(samples, lambda: publisher.put(unit, attachment=b"header"))
        assert sample.payload.to_bytes() == unit
        assert sample.attachment is not None
        assert sample.attachment.to_bytes() == b"header"
        assert sample.timestamp is None, "a router that stamps adds 26 bytes to each message"
        assert query(other, Channel.INFO, keys=KEYS, question=b"this", timeout_s=60) == [b"answer to this"]
        alive = [reply.ok.key_expr for reply in other.liveliness().get("hvt/*/alive") if reply.ok is not None]
        assert [str(key) for key in alive] == ["hvt/uav-1/alive"]
        token.undeclare()


def test_a_ground_that_comes_before_its_router_finds_it(free_port: int) -> None:
    """After a power cut the ground may be up first; it has to start, and connect by itself."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    ground_settings = LinkSettings(role="ground", connect=(endpoint,))
    with ExitStack() as stack:
        ground = stack.enter_context(open_session(ground_settings))
        edge = stack.enter_context(open_session(LinkSettings(role="edge", connect=(endpoint,))))
        samples = ground.declare_subscriber(selector(Channel.BASE))
        publisher = declare_publisher(edge, Channel.BASE, keys=KEYS)
        stack.enter_context(router("--listen", endpoint))
        eventually(lambda: publisher.matching_status.matching)
        assert _first(samples, lambda: publisher.put(b"first")).payload.to_bytes() == b"first"


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_a_signal_ends_it_cleanly(free_port: int, how: signal.Signals) -> None:
    """Otherwise systemd and Docker would wait for their time-out and kill it, and note a failure."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    calling = LinkSettings(role="edge", connect=(endpoint,))
    with router("--listen", endpoint) as process, open_session(calling) as edge:
        eventually(lambda: list(edge.info.routers_zid()))
        process.send_signal(signal.SIGHUP)  # as where a listener hears nothing any more: another session
        assert process.stdout is not None
        assert "listens on" in process.stdout.readline()
        process.send_signal(how)
        assert process.wait() == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--listen", "tcp/0.0.0.0:{free}"], "--insecure"),
        (["--listen", "tcp/127.0.0.1:{taken}"], "in use"),
        (["--zenoh-config", "{peer}", "--listen", "tcp/127.0.0.1:{free}"], 'mode: "router"'),
    ],
)
def test_what_makes_no_router_is_a_sentence(tmp_path: Path, words: list[str], says: str) -> None:
    """Anybody could watch the cameras; or as a peer it would run, and pass nothing on: the hardest fault to find."""
    peer = tmp_path / "peer.json5"
    peer.write_text('{ mode: "peer" }', encoding="utf-8")
    with socket.create_server(("127.0.0.1", 0)) as other:
        named = {"free": free_ports(1)[0], "taken": other.getsockname()[1], "peer": peer}
        command = [sys.executable, str(DEPLOY / "router.py"), *(one.format(**named) for one in words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n"), says in done.stderr) == (2, 1, True), done.stderr
    assert "Traceback" not in done.stderr
