"""A link comes back although what a dark line left behind stands in its way."""

import json
import os
import socket
import stat
import struct
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import json5
import pytest

from hvt_common.runtime.failures import Failures
from hvt_common.transport.own_sockets import TCP_TABLES, own_sockets
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings, configure, end_of
from hvt_fleet.link.stale_sockets import StaleSockets, same_socket
from programs.fleet_keys import Fleet
from programs.processes import eventually
from programs.silent_tunnel import SilentTunnel

PROBE_BYTES = 6
SO_TIMESTAMPNS = 35

pytestmark = pytest.mark.skipif(not TCP_TABLES[0].exists(), reason="needs the kernel's table")


def lingering():
    found = []
    for fd in (int(one.name) for one in Path("/proc/self/fd").iterdir()):
        try:
            if not stat.S_ISSOCK(os.fstat(fd).st_mode):
                continue
            with socket.socket(fileno=os.dup(fd)) as one:
                if struct.unpack("ii", one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))[0]:
                    found.append(fd)
        except OSError:
            continue
    return found


def test_an_end_has_one_spelling():
    """A link of IPv4 on a port of IPv6 would look like a handshake that hangs, or like a stranger."""
    ends = {
        "tcp/127.0.0.1:7447": "127.0.0.1:7447",
        "tls/[::ffff:127.0.0.1]:7447?prio=1-3": "127.0.0.1:7447",
        "tcp/[fe80::1%2]:7447#so_sndbuf=8192": "[fe80::1]:7447",
    }
    assert {locator: end_of(locator) for locator in ends} == ends


def test_a_udp_listener_that_nobody_reads_has_failed():
    """A ground that was stopped for some seconds would show nothing any more, and say that all else is well."""
    failures, told = Failures(time.time_ns), list[bool]()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        host, port = deaf.getsockname()
        config, _ = configure(LinkSettings("ground", listen=(f"udp/{host}:{port}",)))
        watch = StaleSockets(None, config, failures, on_deaf=partial(told.append, True))  # type: ignore[arg-type]
        for check in range(12):
            if 0 < check < 4:  # somebody reads, and more comes than he can take
                deaf.recv(9)
            if check <= 8:
                deaf.sendto(b"one", (host, port))
            watch.check_listeners()
            assert len(failures.now) == (check >= 8)
            stamps = deaf.getsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS)
            assert not stamps, "Zenoh has no room for them: it would not know where a datagram came to"
        (failed,) = failures.now
        assert f"udp {host}:{port} is not read" in failed.reason
        assert failed.reason.endswith("the link is made anew")
        assert told == [True]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as next_one:
            next_one.bind((host, port))


def test_whoever_opened_a_listener_learns_that_it_is_deaf(free_port):
    """No session was ever made anew: a ground that was stopped for some seconds showed nothing any more."""
    failures, told = Failures(time.time_ns), threading.Event()
    here = LinkSettings("ground", listen=(f"udp/127.0.0.1:{free_port}",))
    with (
        open_session(here, failures=failures, on_deaf=told.set),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unread,
    ):
        for inode, fd in own_sockets().items():
            with suppress(OSError), same_socket(fd, inode) as one:
                if one.type == socket.SOCK_DGRAM and one.getsockname() == ("127.0.0.1", free_port):
                    os.dup2(unread.fileno(), fd, inheritable=False)  # which Zenoh does not wait for
        unread.bind(("127.0.0.1", free_port))
        unread.sendto(b"one", ("127.0.0.1", free_port))
        eventually(told.is_set)
    assert [one.part for one in failures.now] == ["listener"]


def test_no_socket_of_zenoh_lingers(free_port):
    """A link that fell dark would hold one of Zenoh's few threads for ten seconds, and whoever comes back with it."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        open_session(LinkSettings("ground", listen=(endpoint,))),
        open_session(LinkSettings("edge", connect=(endpoint,))) as edge,
    ):
        eventually(edge.info.links)
        eventually(lambda: not lingering())


def test_two_sessions_of_one_process_leave_each_other_alone(free_port):
    """Each took the other's link for a handshake that hangs, and ended it every few seconds."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    here = LinkSettings("edge", connect=(endpoint,))
    with (
        open_session(LinkSettings("ground", listen=(endpoint,))),
        open_session(here) as one,
        open_session(here) as other,
    ):
        eventually(lambda: one.info.links() and other.info.links())
        before = [str(link.src) for session in (one, other) for link in session.info.links()]
        time.sleep(2.5)
        assert [str(link.src) for session in (one, other) for link in session.info.links()] == before


def test_sockets_of_a_host_program_are_left_alone(free_port):
    """Its connection to the port that HVT connects to would be shut down, and what it set undone."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    as_zenoh = struct.pack("ii", 1, 10)
    with (
        open_session(LinkSettings("ground", listen=(endpoint,))),
        open_session(LinkSettings("edge", connect=(endpoint,))) as edge,
        socket.create_connection(("127.0.0.1", free_port)) as one,
    ):
        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, as_zenoh)
        eventually(edge.info.links)
        one.settimeout(2.5)
        with pytest.raises(TimeoutError):
            one.recv(1)
        assert one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(as_zenoh)) == as_zenoh


def test_a_watch_outlives_what_goes_wrong_once(free_port, monkeypatch):
    """Without a thread to spare for a probe it ended for good, and sockets of Zenoh lingered again."""
    looks = []
    is_socket = stat.S_ISSOCK

    def look(mode):
        if threading.current_thread().name == "hvt-sockets":
            looks.append(1)
            if len(looks) == 1:
                raise RuntimeError("can't start new thread")
        return is_socket(mode)

    monkeypatch.setattr(stat, "S_ISSOCK", look)
    with open_session(LinkSettings("ground", listen=(f"tcp/127.0.0.1:{free_port}",))):
        eventually(lambda: len(looks) > 1)


def test_a_program_that_leaves_its_session_open_ends_the_watch(free_port):
    """It would not end, or abort without a word: Python can end no thread that is within Zenoh, and start none."""
    code = f"""
import atexit, threading
atexit.register(lambda: print(*(one.name for one in threading.enumerate() if one.name.startswith("hvt-"))))
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
left = open_session(LinkSettings("ground", listen=("tcp/127.0.0.1:{free_port}",)))
left.__enter__()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "\n"


def test_a_number_that_is_another_file_by_now_is_not_copied(tmp_path):
    """Each such copy stayed open."""
    with (tmp_path / "file").open("wb") as file:
        before = len(list(Path("/proc/self/fd").iterdir()))
        for inode in (os.fstat(file.fileno()).st_ino, 1):
            with pytest.raises(OSError, match=r"closed|socket"), same_socket(file.fileno(), inode):
                pass
        assert len(list(Path("/proc/self/fd").iterdir())) == before


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_a_handshake_begun_in_darkness_is_given_up_in_light(tmp_path, free_port, protocol):
    """Behind SSH or a proxy, video would come back seconds after the line."""
    fleet = Fleet(tmp_path / "keys")
    fleet.keys("add-edge", "uav-1")
    fleet.keys("add-ground", "base", "--host", "127.0.0.1")
    patient = json5.loads(fleet.file("uav-1").read_text())
    patient["transport"].setdefault("unicast", {})["open_timeout"] = 1_000_000
    fleet.file("uav-1").write_text(json.dumps(patient))
    with (
        open_session(fleet.settings("base", "ground", listen=(f"{protocol}/127.0.0.1:{free_port}",))),
        SilentTunnel(free_port) as tunnel,
        open_session(
            fleet.settings("uav-1", "edge", connect=(f"{protocol}/127.0.0.1:{tunnel.port}",))
        ) as edge,
    ):
        eventually(edge.info.links)
        tunnel.darken()
        eventually(lambda: tunnel.in_vain)
        tunnel.lighten()
        eventually(edge.info.links, what="a link again")


def test_a_name_whose_first_address_is_dark_has_others(tmp_path, free_port, monkeypatch):
    """With an IPv6 address that no packet reaches, an edge never came to the IPv4 address of the same name."""
    file = tmp_path / "link.json5"
    file.write_text(json.dumps({"transport": {"unicast": {"open_timeout": 1_000_000}}}))
    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (f"127.0.0.{one}", free_port)) for one in (1, 2)]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    ended: list[int] = []
    monkeypatch.setattr(socket.socket, "shutdown", lambda *_: ended.append(1))
    with (
        socket.create_server(("127.0.0.1", free_port), backlog=0),
        socket.create_connection(("127.0.0.1", free_port)),  # from now on nobody is answered there
        open_session(LinkSettings("ground", listen=(f"tcp/127.0.0.2:{free_port}",))),
        open_session(LinkSettings("edge", connect=(f"tcp/127.0.0.1:{free_port}",), zenoh_config=file)),
    ):
        eventually(lambda: ended)


def test_who_answers_slowly_is_waited_for(tmp_path, free_port):
    """A handshake that is long because the other side is would be cut short each time, and no link ever come."""
    slow_s = 2.25
    file = tmp_path / "link.json5"
    retry = {"period_init_ms": 1500, "period_max_ms": 1500, "period_increase_factor": 1}
    file.write_text(json.dumps({"connect": {"retry": retry}}))
    with socket.create_server(("127.0.0.1", 0)) as door:

        def greet(one):
            with one, suppress(OSError):
                first = one.recv(4096)
                if len(first) == PROBE_BYTES:
                    one.sendall(b"!")
                    return
                time.sleep(slow_s)
                with socket.create_connection(("127.0.0.1", free_port)) as other:
                    other.sendall(first)
                    back = threading.Thread(target=pump, args=(other, one), daemon=True)
                    back.start()
                    pump(one, other)

        def pump(one, other):
            with suppress(OSError):
                while data := one.recv(4096):
                    other.sendall(data)

        def serve():
            with suppress(OSError):
                while True:
                    threading.Thread(target=greet, args=[door.accept()[0]], daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        way = f"tcp/127.0.0.1:{door.getsockname()[1]}"
        with (
            open_session(LinkSettings("ground", listen=(f"tcp/127.0.0.1:{free_port}",))),
            open_session(LinkSettings("edge", connect=(way,), zenoh_config=file)) as edge,
        ):
            eventually(edge.info.links, what="a link")
