"""The cost of a group of grounds on its links: real Zenoh sessions of a fleet around a real router.

    python -m lab.scale [EDGES GROUNDS ...]

No video is sent: the traffic by which grounds learn of edges and of each other is counted. Each row is a fleet: bytes
a ground to learn of everything, bytes a second and ground when nothing changes, bytes a ground when one ground
leaves, how long it took until each edge was served again, and the router's processor time. Needs root, for network
namespaces.
"""

import argparse
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import psutil
import zenoh
from rich.console import Console
from rich.table import Table

from hvt_common.protocol.channels import Channel, EdgeKeys, parse_key, selector
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_fleet.link.group import GroundGroup
from lab.link.carriers.star import Star

_ROUTER = Path(__file__).resolve().parents[1] / "deploy" / "router.py"
_FLEETS = ((6, 3), (60, 6), (1000, 40))
_MOST_SESSIONS = 20
"""Sessions of the edges; further ones share them."""
_QUIET_S = 12.0
_POLL_S = 0.25


class _Member:
    """A ground as far as its group goes."""

    def __init__(self, stack: ExitStack, endpoint: str, name: str) -> None:
        self._stack = stack.enter_context(ExitStack())
        session = self._stack.enter_context(open_session(LinkSettings("ground", (), (endpoint,))))
        self.group = self._stack.enter_context(GroundGroup(session, "lab", member=name))
        self.alive: set[str] = set()
        self.served: set[str] = set()
        self._watch = session.liveliness().declare_subscriber(
            selector(Channel.ALIVE), self._note, history=True
        )

    def _note(self, sample: zenoh.Sample) -> None:
        key = parse_key(str(sample.key_expr))
        if key is not None:
            (self.alive.add if sample.kind == zenoh.SampleKind.PUT else self.alive.discard)(key[0])

    def update(self) -> None:
        """As the link of a ground does ten times a second."""
        self.served = {edge for edge in list(self.alive) if self.group.serves(edge)}
        for edge in self.alive - self.served:
            self.group.release(edge)

    def leave(self) -> None:
        """Its tokens go."""
        self._stack.close()


def _members(endpoint: str, count: int, edges: int) -> None:
    """Say each time that all edges are served; a line on standard input has one member leave."""
    with ExitStack() as stack:
        members = [_Member(stack, endpoint, f"base-{number}") for number in range(count)]
        leave = threading.Event()
        threading.Thread(target=lambda: sys.stdin.readline() and leave.set(), daemon=True).start()
        complete = False
        while True:
            if leave.is_set():
                leave.clear()
                members.pop().leave()
                complete = False
            for one in members:
                one.update()
            if not complete and sum(len(one.served) for one in members) == edges:
                complete = True
                print(json.dumps(max(len(one.served) for one in members)), flush=True)
            time.sleep(_POLL_S)


def _edges(endpoint: str, count: int) -> None:
    """Show that they are there, until the end."""
    with ExitStack() as stack:
        settings = LinkSettings("edge", (), (endpoint,))
        sessions = [stack.enter_context(open_session(settings)) for _ in range(min(count, _MOST_SESSIONS))]
        tokens = [
            sessions[number % len(sessions)]
            .liveliness()
            .declare_token(EdgeKeys(f"uav-{number}")[Channel.ALIVE])
            for number in range(count)
        ]
        print(len(tokens), flush=True)
        threading.Event().wait()


@contextmanager
def _running(star: Star, host: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    command = [*star.within(host), sys.executable, *words]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _measure(edges: int, grounds: int) -> list[str]:
    with Star(["edges", "grounds"]) as star, ExitStack() as stack:
        endpoint = f"tcp/{star.address['router']}:7447"
        router = stack.enter_context(
            _running(star, "router", str(_ROUTER), "--listen", endpoint, "--insecure")
        )
        _line(router)
        flown = stack.enter_context(_running(star, "edges", "-m", "lab.scale", "edges", endpoint, str(edges)))
        _line(flown)
        before = star.line_bytes("grounds")
        words = ("-m", "lab.scale", "members", endpoint, str(grounds), str(edges))
        members = stack.enter_context(_running(star, "grounds", *words))
        most = _line(members)
        learned = star.line_bytes("grounds") - before
        quiet = _over(lambda: star.line_bytes("grounds"))
        edge_quiet = _over(lambda: star.line_bytes("edges"))
        before, began_s = star.line_bytes("grounds"), time.monotonic()
        assert members.stdin is not None
        members.stdin.write("leave\n")
        members.stdin.flush()
        _line(members)
        took_s, moved = time.monotonic() - began_s, star.line_bytes("grounds") - before
        cpu = psutil.Process(router.pid).cpu_times()
        return [
            f"{edges}, {grounds}",
            f"{edges / grounds:.0f}, {most}",
            f"{learned / grounds / 1000:.1f} kB",
            f"{quiet / grounds:.0f} B/s",
            f"{edge_quiet / min(edges, _MOST_SESSIONS):.0f} B/s",
            f"{moved / grounds / 1000:.1f} kB",
            f"{took_s:.1f} s",
            f"{cpu.user + cpu.system:.1f} s",
        ]


def _over(counter: Callable[[], int]) -> float:
    before, began_s = counter(), time.monotonic()
    time.sleep(_QUIET_S / 2)
    return (counter() - before) / (time.monotonic() - began_s)


def main(words: list[str]) -> None:
    if words and words[0] == "members":
        _members(words[1], int(words[2]), int(words[3]))
    elif words and words[0] == "edges":
        _edges(words[1], int(words[2]))
    else:
        parser = argparse.ArgumentParser(prog="python -m lab.scale", description=__doc__)
        parser.add_argument("numbers", nargs="*", type=int, help="fleets: edges and grounds of each")
        numbers = parser.parse_args(words).numbers
        table = Table()
        for name in (
            "edges, grounds",
            "edges a ground: mean, most",
            "a ground learns all",
            "a ground, quiet",
            "an edge, quiet",
            "one ground leaves: each other",
            "until all are served",
            "router's processor",
        ):
            table.add_column(name, justify="right")
        for fleet in zip(numbers[::2], numbers[1::2], strict=True) if numbers else _FLEETS:
            table.add_row(*_measure(*fleet))
            Console(width=140).print(table)


if __name__ == "__main__":
    main(sys.argv[1:])
