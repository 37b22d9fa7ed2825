"""A link comes back although what a dark line left behind stands in its way."""

from __future__ import annotations

import json
import os
import socket
import stat
import struct
from pathlib import Path

import json5
import pytest

from hvt_common.transport.session import open_session
from hvt_common.transport.stale_sockets import TCP_TABLES, end_of
from hvt_common.transport.zenoh_config import LinkSettings
from programs.fleet_keys import Fleet
from programs.processes import eventually
from programs.silent_tunnel import SilentTunnel

pytestmark = pytest.mark.skipif(not TCP_TABLES[0].exists(), reason="needs the kernel's table")


def lingering() -> list[int]:
    """Descriptors of this process whose close may wait."""
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


def test_an_end_has_one_spelling() -> None:
    """A link of IPv4 on a port of IPv6 would look like a handshake that hangs, or like a stranger."""
    ends = {
        "tcp/127.0.0.1:7447": "127.0.0.1:7447",
        "tls/[::ffff:127.0.0.1]:7447?prio=1-3": "127.0.0.1:7447",
        "tcp/[fe80::1%2]:7447#so_sndbuf=8192": "[fe80::1]:7447",
    }
    assert {locator: end_of(locator) for locator in ends} == ends


def test_no_socket_of_zenoh_lingers(free_port: int) -> None:
    """A link that fell dark would hold one of Zenoh's few threads for ten seconds, and whoever comes back with it."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        open_session(LinkSettings("ground", listen=(endpoint,))),
        open_session(LinkSettings("edge", connect=(endpoint,))) as edge,
    ):
        eventually(edge.info.links)
        eventually(lambda: not lingering())


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_a_handshake_begun_in_darkness_is_given_up_in_light(
    tmp_path: Path, free_port: int, protocol: str
) -> None:
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
