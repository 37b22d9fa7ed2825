"""Runs hvt-edge and hvt-ground as real processes over a bad link, and gathers the results."""

import json
import shutil
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from hvt_fleet.pki.authority import Authority
from lab.link.carriers.netns import Namespaces
from lab.link.carriers.relay import Relay
from lab.link.carriers.sides import GROUND_HOST, Sides
from lab.link.carriers.tunnel import Tunnel
from lab.link.measures.outcome import Outcome
from lab.link.measures.resources import ResourceSampler
from lab.link.measures.store_left import store_left
from lab.link.measures.timing import read_timing
from lab.link.script import Length, Scenario, Transport
from lab.link.started import Started
from lab.link.timeline import Script
from programs.processes import eventually, free_ports

Carrier = Literal["relay", "netns", "tun"]
CARRIERS: tuple[Carrier, ...] = ("relay", "netns", "tun")

_TAKES_IN_S = 2.5
"""How long the ground may take in messages on their way when the edge has ended."""


@dataclass(frozen=True)
class Run:
    """A run as requested."""

    scenario: Scenario
    source: str
    """As ``--source`` takes it; must last as long as the script."""
    folder: Path
    """Where everything is left."""
    length: Length = "full"
    lasts: str | None = None
    """Another length than the scenario's."""
    carrier: Carrier = "relay"
    seed: int = 0
    edge_arguments: Sequence[str] = ()
    ground_arguments: Sequence[str] = field(default=())

    @property
    def script(self) -> Script:
        script = self.scenario.script(self.length, seed=self.seed, lasts=self.lasts)
        return script.without_delay() if self.carrier == "netns" else script

    @property
    def transport(self) -> Transport:
        """The protocol of edge and ground over it; a shaped veth is there for the kernel's TCP."""
        return "tcp" if self.carrier == "netns" else self.scenario.transport


def run(wanted: Run) -> Outcome:
    """Run one scenario from start to end; nothing is left running.

    Raises:
        UnavailableError: the carrier is netns or tun, and there is none to be had.
        AssertionError: edge or ground did not come up.
    """
    wanted.folder.mkdir(parents=True, exist_ok=True)
    script, timing = wanted.script, wanted.folder / "timing.csv"
    for old in (timing, *wanted.folder.glob("run*.rrd")):
        old.unlink(missing_ok=True)
    shutil.rmtree(wanted.folder / "store", ignore_errors=True)
    kind, (port,) = wanted.transport, free_ports(1)
    keys = _keys(wanted.folder / "keys") if kind == "quic" else {"edge": [], "ground": []}
    with _carrier(wanted, script, target_port=port) as link, ExitStack() as stack:
        if isinstance(link, Sides):
            sides, open_to_all = {side: link.prefix(side) for side in link.names}, ["--insecure"]
            listen = connect = f"{kind}/{GROUND_HOST}:{port}"
        else:
            sides, open_to_all = {"edge": [], "ground": []}, []
            listen, connect = f"{kind}/127.0.0.1:{port}", f"{kind}/127.0.0.1:{link.port}"
        ground = stack.enter_context(Started("ground", wanted.folder, [
            *sides["ground"], sys.executable, "-m", "hvt_ground.cli", "--timing", str(timing), "--listen", listen,
            *open_to_all, *keys["ground"], "--record", str(wanted.folder / "run.rrd"), *wanted.ground_arguments,
        ]))  # fmt: skip
        ground.until("listening on")
        edge = stack.enter_context(Started("edge", wanted.folder, [
            *sides["edge"], sys.executable, "-m", "hvt_edge.cli", "--connect", connect, "--wait", "60s",
            *keys["edge"], "--source", wanted.source, "--budget", wanted.scenario.budget,
            "--store-folder", str(wanted.folder / "store"), *wanted.edge_arguments,
        ]))  # fmt: skip
        eventually(lambda: _playing(edge, timing), what="a first frame reaches the ground")
        began_s = link.begin()
        with ResourceSampler({"edge": edge.process.pid, "ground": ground.process.pid}) as watch:
            _wait(began_s + script.lasts_s, edge, ground)
        watch.save(wanted.folder / "resources.csv")
        codes = {"edge": edge.end()}
        # Not --once: a ground with it leaves in an outage that is longer than its patience.
        _wait(time.time() + _TAKES_IN_S, ground)
        codes["ground"] = ground.end()
    return Outcome(
        scenario=wanted.scenario.name,
        script=script,
        began_s=began_s,
        arrivals=read_timing(timing),
        edge=edge.left(),
        ground=ground.left(),
        samples=watch.samples,
        exit_codes=codes,
        said={"edge": edge.said, "ground": ground.said},
        stored=store_left(wanted.folder / "store"),
    )


def _carrier(wanted: Run, script: Script, *, target_port: int) -> Relay | Sides:
    if wanted.carrier == "netns":
        return Namespaces(script)
    if wanted.carrier == "tun":
        return Tunnel(script, seed=wanted.seed)
    return Relay(
        script,
        protocol="tcp" if wanted.transport == "tcp" else "udp",
        target_port=target_port,
        seed=wanted.seed,
    )


def _keys(folder: Path) -> dict[str, list[str]]:
    """A certificate for the ground, which QUIC demands, and the arguments of both sides."""
    shutil.rmtree(folder, ignore_errors=True)
    Authority.create(folder).issue("ground", hosts=("127.0.0.1", str(GROUND_HOST)))
    written = {
        "edge": {"root_ca_certificate": "ca.pem"},
        "ground": {"listen_certificate": "ground.pem", "listen_private_key": "ground.key"},
    }
    for side, files in written.items():
        paths = {name: str(folder.absolute() / file) for name, file in files.items()}
        (folder / f"{side}.json5").write_text(json.dumps({"transport": {"link": {"tls": paths}}}))
    return {side: ["--zenoh-config", str(folder / f"{side}.json5")] for side in written}


def _playing(edge: Started, timing: Path) -> bool:
    assert edge.alive, f"the edge ended early:\n{edge.said}"
    return bool(read_timing(timing))


def _wait(until_s: float, *processes: Started) -> None:
    while time.time() < until_s and any(one.alive for one in processes):
        time.sleep(min(0.1, max(0.0, until_s - time.time())))
