"""What is not there yet is waited for, with a sentence, while everything else runs: an address, a port, a device."""

import os
import pty
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from itertools import product
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from hvt_archive.viewer import LiveView
from hvt_common.config import load
from hvt_common.errors import FlightError, NotYetError, UserError, exit_with_sentence
from hvt_common.runtime.failures import Awaited, Failures
from hvt_common.runtime.reporting import check_writable
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig, check
from hvt_edge.loop.pose import open_pose
from hvt_edge.source.contract import SourceSettings
from hvt_edge.source.live import Grabber, LiveSource, Shot, SignalLost
from hvt_edge.source.opening import open_source
from hvt_edge.world import World
from hvt_fleet.health.server import Answer, HealthServer
from hvt_ground.sinks.rerun.live_view import listening
from hvt_web.server import WebPage
from programs.processes import answers, eventually, free_ports
from programs.rtsp_camera import RtspCamera

_HOLD = """
import socket, sys
one = socket.socket(socket.AF_INET, getattr(socket, sys.argv[1]))
one.bind(("127.0.0.1", 0))
if sys.argv[1] == "SOCK_STREAM":
    one.listen()
print(one.getsockname()[1], flush=True)
sys.stdin.read()
"""


class Holder:
    """Another program that has a port of loopback, until it lets go."""

    def __init__(self, kind: str = "SOCK_STREAM") -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _HOLD, kind], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.port = int(self._process.stdout.readline())

    def let_go(self) -> None:
        self._process.communicate("")


class HeldHere:
    """Another part of this program that has it."""

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]

    def let_go(self) -> None:
        self._socket.close()


@contextmanager
def metrics(holder: Holder, failures: Failures) -> Iterator[Callable[[], bool]]:
    found = {"/": lambda: Answer(b"ok")}
    with HealthServer(f"127.0.0.1:{holder.port}", found, failures=failures):
        yield lambda: answers(holder.port)


@contextmanager
def web(holder: Holder, failures: Failures) -> Iterator[Callable[[], bool]]:
    with WebPage(f"127.0.0.1:{holder.port}", clock=time.time_ns, failures=failures):
        yield lambda: answers(holder.port)


@contextmanager
def listener(holder: Holder, failures: Failures, protocol: str = "tcp") -> Iterator[Callable[[], bool]]:
    settings = LinkSettings(role="ground", listen=(f"{protocol}/127.0.0.1:{holder.port}",))
    other = LinkSettings(role="edge", connect=settings.listen)
    with open_session(settings, failures=failures) as session, open_session(other):
        yield lambda: bool(session.info.links())


@contextmanager
def without_its_doctor(holder: Holder, failures: Failures) -> Iterator[Callable[[], bool]]:
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        patch.setattr("hvt_common.runtime.plug_ins.installed", lambda _group: {})
        yield stack.enter_context(listener(holder, failures))


@pytest.mark.parametrize(
    ("opened", "held"),
    [*product([metrics, web, listener, without_its_doctor], [Holder]), (listener, HeldHere)],
)
def test_a_port_that_another_program_holds_is_waited_for(opened, held, caplog):
    """The ground of before takes a second to end, and the service is not started again: code 2 is for ever.

    With --web on the link's own port the ground said that it listened there, and no edge came.
    """
    holder, failures = held(), Failures(time.time_ns)
    with opened(holder, failures) as works:
        (failed,) = failures.now
        assert "in use" in failed.reason
        assert str(holder.port) in failed.reason
        assert len([one for one in caplog.messages if failed.reason in one]) == 1
        holder.let_go()
        eventually(works, what="it works")
        eventually(lambda: not failures.now, what="it says so")


@pytest.mark.parametrize("opened", [metrics, web, listener])
def test_who_waits_for_a_port_ends_at_once(opened):
    """Ctrl-C would do nothing until the port is free, which it is here after the end alone."""
    with opened(holder := Holder(), Failures(time.time_ns)):
        pass
    holder.let_go()


@pytest.mark.parametrize(
    "open_it",
    [
        lambda at, failures: HealthServer(f"{at}:9464", {}, failures=failures),
        lambda at, failures: WebPage(f"{at}:80", clock=time.time_ns, failures=failures),
    ],
    ids=["metrics", "web"],
)
@pytest.mark.parametrize(
    ("at", "says"),
    [("192.0.2.1", "this machine has no such address"), ("ground.field.invalid", "give another host")],
)
def test_an_address_that_is_not_there_yet_is_no_wrong_setting(open_it, at, says, tmp_path, monkeypatch):
    """The VPN comes up some seconds after the ground, and so does the server of names; another port mends neither."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    failures = Failures(time.time_ns)
    with open_it(at, failures):
        assert at in failures.now[0].reason
        assert failures.now[0].reason.endswith(says)


def test_a_link_waits_for_an_address(caplog):
    """The same, of the link, also where this program listens on that port of another address."""
    failures = Failures(time.time_ns)
    with socket.create_server(("127.0.0.1", 0)) as other:
        there = (f"tcp/192.0.2.1:{other.getsockname()[1]}",)
        with open_session(LinkSettings(role="ground", listen=there, insecure=True), failures=failures):
            assert "this machine has no such address" in failures.now[0].reason


def test_the_viewer_waits_for_its_port(caplog):
    """Somebody has a viewer open, and the ground does not start."""
    holder, other = Holder(), free_ports(1)[0]
    with pytest.raises(NotYetError, match=f"port {holder.port}"):
        LiveView("serve", port=holder.port, web_port=other)
    with LiveView("serve", port=holder.port, web_port=other, later=True) as view:
        assert f"port {holder.port}" in caplog.text
        with pytest.raises(NotYetError):
            view.start_again()
        holder.let_go()
        view.start_again()
        assert listening(holder.port)


def test_a_camera_that_starts_later_is_waited_for(caplog):
    """It boots slower than the computer: nobody would look at the drone again."""
    (port,) = free_ports(1)
    failures, stop = Failures(time.time_ns), threading.Event()
    url = f"rtsp://127.0.0.1:{port}/camera"
    awaited = Awaited(
        lambda: open_source(url, size=(320, 240), fps=5, fit="crop"), "source", failures, longest_s=1
    )
    assert awaited.part is None
    assert url in failures.now[0].reason
    with ExitStack() as stack:
        found = []
        thread = threading.Thread(target=lambda: found.append(awaited.wait(stop)))
        thread.start()
        stack.enter_context(RtspCamera(port))
        eventually(lambda: found, what="it is found")
        thread.join()
        stack.enter_context(closing(found[0]))
        assert next(found[0].frames(start_ns=0)).index == 0
    assert not failures.now


class Silent(Grabber):
    """A camera that opens and gives nothing."""

    name, notes = "camera", None

    def open(self) -> None:
        """It opens."""

    def restart(self) -> None:
        """It opens again."""

    def close(self) -> None:
        """There is nothing to close."""

    def grab(self) -> Shot:
        raise SignalLost("no frame")


def read_settings(path: str) -> object:
    return load(EdgeConfig, ("--config", path), program="hvt-edge", description="")


def in_flight(source: str) -> object:
    return World().open_source(EdgeConfig(source=source))


def read_keys(path: str) -> object:
    return configure(LinkSettings("edge", zenoh_config=Path(path)))


@pytest.mark.parametrize(
    ("open_it", "kind"),
    [
        pytest.param(lambda: open_source("/dev/video97", size=(64, 64), fps=5), NotYetError, id="no device"),
        pytest.param(lambda: open_source("/dev/null", size=(64, 64), fps=5), UserError, id="no camera"),
        pytest.param(
            lambda: LiveSource(Silent(), SourceSettings(size=(64, 64), fps=5)),
            NotYetError,
            id="no picture yet",
        ),
        pytest.param(lambda: open_source("clip.mp4", size=(64, 64), fps=5), UserError, id="no clip"),
        pytest.param(lambda: in_flight("/not/mounted/a.mp4"), FlightError, id="no disk of clips"),
        pytest.param(lambda: in_flight("/dev/v4l/none/usb-1"), NotYetError, id="no device of that name"),
        pytest.param(lambda: in_flight("v4l2src device=/none/0 ! appsink"), UserError, id="no clip: a pipe"),
        pytest.param(lambda: read_settings("/not/mounted/a.toml"), NotYetError, id="no disk of settings"),
        pytest.param(lambda: read_settings("none.toml"), UserError, id="no settings"),
        pytest.param(lambda: read_keys("/not/mounted/a.json5"), NotYetError, id="no disk of keys"),
        pytest.param(lambda: read_keys("none.json5"), UserError, id="no keys"),
        pytest.param(
            lambda: check_writable(Path("/not/mounted/a.rrd"), name="--record"), NotYetError, id="no disk yet"
        ),
        pytest.param(lambda: check_writable(Path("/"), name="--record"), UserError, id="a folder"),
    ],
)
def test_only_what_can_never_work_ends_with_code_2(open_it, kind, capsys):
    """A supervisor starts again whatever may work then, and nothing else."""

    def run(_argv: object) -> int:
        open_it()
        return 0

    with pytest.raises((UserError, FlightError)) as raised:
        open_it()
    assert type(raised.value) is kind
    assert exit_with_sentence(run, program="hvt", argv=None) == (2 if kind is UserError else 1)
    assert capsys.readouterr().err.count("\n") == 1


def test_a_folder_that_is_gone_from_under_a_shell_is_said(tmp_path, monkeypatch, capsys):
    """Whoever has made a folder anew got a traceback of the first relative name, whatever was asked."""
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    assert exit_with_sentence(lambda _: 0, program="hvt", argv=None) == 2
    assert "folder that this was started in is gone" in capsys.readouterr().err


POSITION = ardupilotmega.MAVLink(None).global_position_int_encode(0, 10**7, 2 * 10**7, 0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize("kind", ["udpin", "tcp", "serial"])
def test_an_autopilot_that_starts_later_is_waited_for(kind, caplog):
    """A flight would not begin because its map is not ready."""
    data = POSITION.pack(ardupilotmega.MAVLink(None))
    with ExitStack() as stack:
        if kind == "udpin":
            holder = Holder("SOCK_DGRAM")
            address, port = f"udpin:127.0.0.1:{holder.port}", holder.port
            sender = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            send = lambda: sender.sendto(data, ("127.0.0.1", port))  # noqa: E731
        elif kind == "tcp":
            (port,) = free_ports(1)
            address = f"tcp:127.0.0.1:{port}"
        else:
            controller, device = pty.openpty()
            stack.callback(os.close, controller)
            address = f"/dev/hvt-test-{os.getpid()}"
        source = stack.enter_context(
            closing(open_pose(f"mavlink:{address}", hfov_deg=60, clock=time.time_ns))
        )
        assert "is tried again" in caplog.text
        assert source.trouble
        if kind == "udpin":
            holder.let_go()
        elif kind == "tcp":
            server = stack.enter_context(socket.create_server(("127.0.0.1", port)))
            vehicle, _ = server.accept()
            stack.enter_context(vehicle)
            send = lambda: vehicle.sendall(data)  # noqa: E731
        else:
            link = Path(address)
            try:
                link.symlink_to(os.ttyname(device))
            except OSError:
                pytest.skip("/dev cannot be written")
            stack.callback(link.unlink)
            send = lambda: os.write(controller, data)  # noqa: E731

        def placed() -> bool:
            send()
            return source.at(0, capture_ns=0) is not None

        eventually(placed, what="there is a pose")
        assert not source.trouble


@pytest.mark.nightly
def test_a_whole_ground_waits_and_serves(link, scene):
    """All of it at once, as a service meets it after a boot."""
    holders = [Holder() for _ in range(3)]
    link.port = holders[0].port
    page, numbers = (f"127.0.0.1:{one.port}" for one in holders[1:])
    models = ("--detector", "motion", "--classifier", "none")
    ground = link.ground("--web", page, "--metrics", numbers, *models)
    for part in ("listener", "web page", "metrics"):
        ground.until(f"hvt-ground: {part}: ")
    assert "hvt-ground: not yet listening on" in ground.said
    ground.until(f"not yet, watch at http://{page}/")  # another program's page is there now
    for one in holders:
        one.let_go()
    for part in ("listener", "web page", "metrics"):
        ground.until(f"{part}: works again")
    edge = link.edge("--source", str(scene), "--max-frames", "20", "--fps", "5", "--detector", "motion")
    assert edge.wait() == 0, edge.said
    ground.kill()


def test_an_edge_waits_for_its_camera_and_can_be_stopped(caplog):
    """Nobody would start it again; or only kill -9 ends it."""
    config = EdgeConfig(source="/dev/video97", detector="motion", connect=("tcp/127.0.0.1:9",), quiet=True)
    stop = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        flight = pool.submit(Edge(check(config), stop=stop).run)
        try:
            eventually(lambda: "/dev/video97 does not exist" in caplog.text, what="it says what it waits for")
            assert not flight.done()
        finally:
            stop.set()
        with pytest.raises(FlightError, match="stopped before the source was there"):
            flight.result()
