"""Runs hvt-edge and hvt-ground as real processes over a bad link, and gathers what became of it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

from link.measures import Outcome
from link.netns import GROUND_HOST, Namespaces
from link.relay import Relay
from link.script import Length, Scenario, Script
from link.timing import read_timing
from link.watch import Watch
from processes import Running, eventually, free_ports

__all__ = ["Carrier", "Run", "run"]

Carrier = Literal["relay", "netns"]

_TIMED_GROUND = Path(__file__).with_name("timed_ground.py")
_START_S = 60.0
_END_S = 25.0
_TAKES_IN_S = 2.5
"""How long the ground may take in what is on its way when the edge has ended."""


@dataclass(frozen=True)
class Run:
    """What is to be run."""

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
        """What the link will do."""
        script = self.scenario.script(self.length, seed=self.seed, lasts=self.lasts)
        return script.without_delay() if self.carrier == "netns" else script


def run(asked: Run) -> Outcome:
    """Run one scenario from start to end; nothing is left running.

    Raises:
        UnavailableError: the carrier is netns, and there are none to be had.
        AssertionError: edge or ground did not come up.
    """
    asked.folder.mkdir(parents=True, exist_ok=True)
    script, timing = asked.script, asked.folder / "timing.csv"
    timing.unlink(missing_ok=True)
    with ExitStack() as stack:
        (port,) = free_ports(1)
        link: Relay | Namespaces
        if asked.carrier == "netns":
            link = stack.enter_context(Namespaces(script))
            sides = {side: link.prefix(side) for side in link.names}
            listen = connect = f"tcp/{GROUND_HOST}:{port}"
        else:
            link = stack.enter_context(Relay(script, target_port=port, seed=asked.seed))
            sides = {"edge": [], "ground": []}
            listen, connect = f"tcp/127.0.0.1:{port}", f"tcp/127.0.0.1:{link.port}"
        ground = stack.enter_context(_Process("ground", asked.folder, [
            *sides["ground"], sys.executable, str(_TIMED_GROUND), str(timing), "--listen", listen,
            *(["--insecure"] if asked.carrier == "netns" else []), "--record", str(asked.folder / "run.rrd"),
            *asked.ground_arguments,
        ]))  # fmt: skip
        ground.until("listening on", within_s=_START_S)
        edge = stack.enter_context(_Process("edge", asked.folder, [
            *sides["edge"], sys.executable, "-m", "hvt_edge.cli", "--connect", connect, "--wait", "60s",
            "--source", asked.source, "--budget", asked.scenario.budget, *asked.edge_arguments,
        ]))  # fmt: skip
        eventually(lambda: _playing(edge, timing), within_s=_START_S, what="a first frame reaches the ground")
        began_s = link.begin()
        with Watch({"edge": edge.process.pid, "ground": ground.process.pid}) as watch:
            _wait(began_s + script.lasts_s, edge, ground)
        codes = {"edge": edge.end()}
        # Not --once: a ground with it leaves in an outage that is longer than its patience.
        _wait(time.time() + _TAKES_IN_S, ground)
        codes["ground"] = ground.end()
    return Outcome(
        scenario=asked.scenario.name,
        script=script,
        began_s=began_s,
        arrivals=read_timing(timing),
        edge=edge.left(),
        ground=ground.left(),
        samples=watch.samples,
        exit_codes=codes,
        said={"edge": edge.said, "ground": ground.said},
    )


def _playing(edge: _Process, timing: Path) -> bool:
    assert edge.alive, f"the edge ended early:\n{edge.said}"
    return bool(read_timing(timing))


def _wait(until_s: float, *processes: _Process) -> None:
    while time.time() < until_s and any(one.alive for one in processes):
        time.sleep(min(0.1, max(0.0, until_s - time.time())))


class _Process(Running):
    """`Running` with any command, so that it can run inside a namespace; killed at the end of the context."""

    def __init__(self, name: str, folder: Path, command: list[str]) -> None:
        self.name = name
        self._summary = folder / f"{name}.json"
        self._out, self._err = folder / f"{name}.out", folder / f"{name}.err"
        self._summary.unlink(missing_ok=True)
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                [*command, "--summary", str(self._summary)],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
            )

    def end(self) -> int | None:
        """Ctrl-C where it still runs, then kill; the exit code, None where it had to be killed."""
        if self.alive:
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.kill()
            return None

    def left(self) -> Any:
        """Its summary; several (after an outage) as one; None where it left none."""
        if not self._summary.exists():
            return None
        content = self.summary()
        return _summed(content) if isinstance(content, list) else content

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        if self.alive:
            self.kill()


def _summed(summaries: list[dict[str, Any]]) -> dict[str, Any] | None:
    if not summaries:
        return None
    counts = {
        name: sum(one[name] for one in summaries)
        for name, value in summaries[0].items()
        if isinstance(value, int | float)
    }
    return {**counts, "stills": {"received": sum(one["stills"]["received"] for one in summaries)}}
