"""Who knocks and is refused is named, once a minute; who has a link is not."""

import itertools
import logging
import socket
import time
from pathlib import Path

import pytest

from hvt_common.transport.session import open_session
from hvt_fleet.link.diagnose import Watch
from hvt_fleet.link.strangers import Strangers, listening_ports
from programs.fleet_keys import Fleet
from programs.processes import eventually

pytestmark = pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="needs the kernel's table")


def knock(port: int, *, host: str = "127.0.0.2") -> None:
    """A program that speaks neither TLS nor Zenoh, such as a scanner of ports, on another host than the edges."""
    with socket.create_connection(("127.0.0.1", port), source_address=(host, 0)):
        time.sleep(0.3)


def test_a_stranger_is_named_and_an_edge_is_not(tmp_path: Path, free_port: int, caplog) -> None:
    """Somebody would try the door of a ground all day, and its log says nothing; or each edge would look like it."""
    fleet = Fleet(tmp_path / "keys")
    fleet.keys("add-edge", "uav-1")
    fleet.keys("add-ground", "base", "--host", "127.0.0.1")
    endpoint = f"tls/127.0.0.1:{free_port}"
    ground = fleet.settings("base", "ground", listen=(endpoint,))
    edge = fleet.settings("uav-1", "edge", connect=(endpoint,))

    def said() -> list[str]:
        return [one.getMessage() for one in caplog.records if "refused" in one.getMessage()]

    with (
        caplog.at_level(logging.WARNING),
        open_session(ground) as session,
        Watch(session, ground, served=lambda _name: True),
    ):
        for _ in range(4):
            with open_session(edge) as own:
                eventually(lambda own=own: own.info.links(), what="the edge has a link")
                time.sleep(0.3)
        for _ in range(13):  # the ground's own command line: less than a look of the watch each
            with open_session(edge) as own:
                eventually(lambda own=own: own.info.links(), what="the client has a link")
        for _ in range(4):  # an edge whose link breaks off before there is one
            knock(free_port, host="127.0.0.1")
        assert said() == []
        eventually(lambda: knock(free_port) or said(), what="the stranger is named")
    assert len(said()) == 1
    assert said()[0].startswith("somebody at 127.0.0.2 connects again and again and is refused")


def test_each_stranger_once_a_minute(tmp_path: Path) -> None:
    """A scanner would fill the log."""
    header = (
        "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n"
    )
    table = tmp_path / "tcp"
    table.write_text(header)

    def shown(now_s: float, *far_ends: str, links: tuple[str, ...] = ()) -> list[str]:
        lines = [f"   0: 00000000:1D17 {one} 01 0 0 0 0 0 0 0\n" for one in far_ends]
        lines.append(
            "   1: 00000000:1D17 00000000:0000 0A 0 0 0 0 0 0 0\n   2: 0100007F:0016 0200000A:9999 01 0 0 0 0 0 0 0\n"
        )
        table.write_text(header + "".join(lines))
        return strangers.check(lambda: links, now_s)

    strangers = Strangers(
        listening_ports(["tls/0.0.0.0:7447", "udp/0.0.0.0:22"]),
        tables=[table],
        accepted=itertools.count().__next__,
    )
    told = [(at_s, host) for at_s in range(100) for host in shown(at_s, *(["0700000A:A000"] * (at_s % 2)))]
    assert told == [(6, "10.0.0.7"), (66, "10.0.0.7")]
    for at_s in range(100, 120, 2):
        assert shown(at_s, "0800000A:A001") == []
        assert shown(at_s + 1, "0800000A:A001", links=("10.0.0.8:40961",)) == [], (
            "it takes its time and is in"
        )
        assert shown(at_s + 1.5) == []
    for number in range(6):
        lost, found = (f"0900000A:A{number + more:03X}" for more in (0, 1))
        links = (f"10.0.0.9:{0xA000 + number}", f"10.0.0.9:{0xA001 + number}")
        assert shown(120 + number, lost, links=links[:1]) == []
        both = shown(120.5 + number, lost, found, links=links[1:])
        assert both == [], "the link is lost and made again; the kernel still has its old connection"
    strangers.note_links(["10.0.0.10:41000", "10.0.0.1:7447"])
    for number in range(6):
        assert shown(200 + number, f"0A00000A:A{number:03X}") == [], "its link was there between two looks"
        assert shown(200.5 + number) == []
    for number in range(6):
        told += [(0, host) for host in shown(300 + number, f"0100000A:A{number:03X}")]
        told += [(0, host) for host in shown(300.5 + number)]
    assert told[2:] == [(0, "10.0.0.1")], "our own end of a link is nobody's"


def test_the_table_is_read_only_where_somebody_has_come(tmp_path: Path) -> None:
    """Reading it ten times a second would take 7 % of a core of each ground, day and night."""
    table = tmp_path / "tcp"
    line = "   0: 00000000:1D17 0700000A:A000 01 0 0 0 0 0 0 0\n"
    table.write_text("header\n")
    accepted = iter([5, 5, 6, 6, 6])
    strangers = Strangers([7447], tables=[table], accepted=lambda: next(accepted))
    assert strangers.check(list, 0) == []
    table.unlink()
    assert strangers.check(list, 1) == [], "not read"
    table.write_text("header\n" + line)
    assert strangers.check(list, 2) == [], "it is pending"
    assert strangers.check(lambda: ["10.0.0.7:40960"], 3) == [], "and has a link"
    table.unlink()
    assert strangers.check(list, 4) == [], "not read"
