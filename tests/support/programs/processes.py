"""Starts hvt-edge and hvt-ground as real processes, for tests, and gathers what they say and leave behind."""

import functools
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, Self

from hvt_common.protocol.edge_words import FRAME_GROUPS, FrameAccount

PATIENT_S = 200.0
"""A machine that is busy is waited for. It is no assertion on speed, only less than what pytest gives a test."""
_POLL_S = 0.01
MOST_SAID = 8000
"""Characters of what a process said, its last, that a test's failure repeats."""


class _Ports:
    """Ports that belong to this process alone, so that tests in several processes never pick the same one.

    A process owns a block of ports for as long as it holds the block's first one. The blocks end below 32768, where
    Linux and macOS begin to number outgoing connections.
    """

    FIRST, LAST, BLOCK = 18_000, 32_000, 200

    def __init__(self) -> None:
        for base in range(self.FIRST, self.LAST, self.BLOCK):
            if (held := _bound(base)) is not None:
                self._held = held
                self._ports = itertools.cycle(range(base + 1, base + self.BLOCK))
                return
        raise RuntimeError(f"every block of ports from {self.FIRST} to {self.LAST} is in use")

    def free(self) -> int:
        """The next port of the block on which nobody listens."""
        for port in itertools.islice(self._ports, self.BLOCK):
            if (probe := _bound(port)) is not None:
                probe.close()
                return port
        raise RuntimeError("every port of this process is in use")


def _bound(port: int) -> socket.socket | None:
    """A socket bound to the port on all addresses; None where somebody else has it."""
    bound = socket.socket()
    try:
        bound.bind(("", port))
    except OSError:
        bound.close()
        return None
    return bound


_ports = functools.cache(_Ports)


def free_ports(number: int) -> list[int]:
    """TCP ports that nobody listens on at this moment, all different, and that no other test process picks."""
    return [_ports().free() for _ in range(number)]


def python(code: str, *words: str, check: bool = True, **more: Any) -> subprocess.CompletedProcess[str]:
    """A Python that runs the code with these words, to its end; what it says is text."""
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, capture_output=True, text=True, check=check, **more)


@contextmanager
def router(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """``deploy/router.py``, listening."""
    program = Path(__file__).resolve().parents[3] / "deploy" / "router.py"
    command = [sys.executable, str(program), *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert "listens on" in process.stdout.readline()
            yield process
        finally:
            process.kill()


def answers(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def eventually(true: Callable[[], object], *, what: str = "that it is so") -> None:
    """Wait until ``true()``; fail where it does not become so in time."""
    deadline_s = time.monotonic() + PATIENT_S
    while not true():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"not within {PATIENT_S:g} s: {what}")
        time.sleep(_POLL_S)


class Sessions(list[dict[str, Any]]):
    """The summaries of a ground's sessions; a test that takes them for one fails with what became of each."""

    said = ""

    def __getitem__(self, key: Any) -> Any:
        ends = (
            [(one["session"], one["frames"], one["failed"]) for one in self] if isinstance(key, str) else ()
        )
        assert not isinstance(key, str), (
            f"{len(self)} sessions, not one: {ends}; the ground said:\n{self.said}"
        )
        return super().__getitem__(key)


class Running:
    """One process; its output goes to files, so that it never waits for a reader.

    ``within`` goes before its command, such as ``ip netns exec NAME``. ``HVT_TEST_SLEEPS``, a share, has it sleep at
    so many of its calls (`sleeping`).
    """

    def __init__(
        self, module: str, arguments: list[str], *, folder: Path, name: str, within: Sequence[str] = ()
    ) -> None:
        self.name = name
        self._summary = folder / f"{name}.json"
        self._out, self._err = folder / f"{name}.out", folder / f"{name}.err"
        share = os.environ.get("HVT_TEST_SLEEPS")
        begins = ["-m"] if share is None else [str(Path(__file__).with_name("sleeping.py")), share]
        command = [*within, sys.executable, *begins, module, "--summary", str(self._summary), *arguments]
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                cwd=folder,
                env={**os.environ, "COLUMNS": "200"},
            )

    @property
    def said(self) -> str:
        return self._err.read_text(errors="replace")

    @property
    def told(self) -> str:
        """Standard output so far: the table at the end."""
        return self._out.read_text(errors="replace")

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def until(self, text: str) -> float:
        """Wait until standard error holds ``text``; return the Unix time of noticing."""

        def found() -> bool:
            assert text in self.said or self.alive, f"{self.name} ended early:\n{self.said}"
            return text in self.said

        try:
            eventually(found, what=f"{self.name} says {text!r}")
        except AssertionError as error:
            error.add_note(f"it said:\n{self.said[-MOST_SAID:]}")
            raise
        return time.time()

    def wait(self) -> int:
        """The exit code; fails with what the process said where it does not end in time."""
        try:
            return self.process.wait(PATIENT_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{self.name} still runs after {PATIENT_S:g} s:\n{self.said}") from None

    def finish(self) -> dict[str, Any]:
        """Wait for a good end; return the summary. Of an edge that nobody received 1 is the code of a good end."""
        code = self.wait()
        summary = self.summary() if code == 1 and self._summary.exists() else {}
        in_vain = bool(
            summary and summary["unreached"] and summary["frames"] and not summary["frames_stored"]
        )
        assert code == in_vain, f"{self.name} ended with {code}:\n{self.said}"
        assert "Traceback" not in self.said, self.said
        return self.summary()

    def stop(self, sign: signal.Signals = signal.SIGINT) -> float:
        """Ctrl-C, or another signal; return the seconds until the process had ended."""
        began_s = time.monotonic()
        self.process.send_signal(sign)
        self.wait()
        return time.monotonic() - began_s

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(PATIENT_S)

    def summary(self) -> Any:
        """The JSON that it left. Of an edge: every source frame is in one group, and the table says the same."""
        assert self._summary.exists(), f"{self.name} left no summary; it said:\n{self.said}"
        content = json.loads(self._summary.read_text())
        if isinstance(content, list):
            content = Sessions(content)
            content.said = self.said[-MOST_SAID:]
            for told in filter(None, (session.get("edge_frames") for session in content)):
                assert sum(told[name] for name in FRAME_GROUPS) == told["came"], told
        if isinstance(content, dict) and (frames := content.get("frame_account")):
            groups = {name: count for name, count in frames.items() if name in FRAME_GROUPS}
            assert sum(groups.values()) == frames["came"] == content["frames_captured"], frames
            assert str(FrameAccount(groups)).split(":")[0] == frames["text"].split(":")[0]
            assert content["frames"] == groups["sent"] + groups["nobody_listened"], frames
        return content


def agree(sent: dict[str, Any], received: dict[str, Any]) -> None:
    """The summaries of an edge and of the ground that had all of its flight."""
    failed = f"at the edge {sent['failed']}, at the ground {received['failed']}"
    assert sent["frames"] == received["frames"] > 0, failed
    assert sent["base_bytes"] == received["base_bytes"] > 0, failed
    # On a busy machine a report may be late, and a base frame. A still that is sent again counts once; twice where it
    # has a new number, because it had to do without the base.
    copies = sent["stills"]["reasons"]["sent"].get("again", 0)
    assert 0 <= sent["stills"]["sent"] - received["stills"]["received"] <= copies, failed
    # A copy counts at the ground as well, if it comes before the end.
    assert received["roi_bytes"] <= sent["roi_bytes"]
    assert copies or received["roi_bytes"] == sent["roi_bytes"]


class Link:
    """A ground and its edges on ports of their own. A context manager that leaves no process behind.

    Whatever fails within it tells what each of them said.
    """

    flights: ClassVar[Collection[str] | None] = None
    """Names of all that may be flown; None: any."""

    def __init__(self, folder: Path, *, name: str = "") -> None:
        assert self.flights is None or name in self.flights, "it is no golden flight: mark its test nightly"
        self.folder = folder
        self.port, self.edge_port = free_ports(2)
        self._started: list[Running] = []

    @property
    def ground_endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    @property
    def edge_endpoint(self) -> str:
        """Where an edge started with ``listens=True`` listens, too."""
        return f"tcp/127.0.0.1:{self.edge_port}"

    def ground(
        self, *arguments: str, name: str = "ground", connects: bool = False, up: bool = True
    ) -> Running:
        where = ["--connect", self.edge_endpoint] if connects else ["--listen", self.ground_endpoint]
        running = self.start("hvt_ground.cli", [*where, *arguments], name=name)
        if up:
            running.until("connecting to" if connects else "listening on")
        return running

    def edge(self, *arguments: str, name: str = "edge", listens: bool = False) -> Running:
        """Start an edge that connects to the ground's port; with ``listens`` others can connect to it."""
        where = ["--connect", self.ground_endpoint]
        where += ["--listen", self.edge_endpoint] if listens else []
        return self.start("hvt_edge.cli", [*where, *arguments], name=name)

    def start(self, module: str, arguments: list[str], *, name: str) -> Running:
        running = Running(module, arguments, folder=self.folder, name=name)
        self._started.append(running)
        return running

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        for running in self._started:
            if running.alive:
                running.kill()
            if error is not None:
                error.add_note(f"{running.name} said:\n{running.said[-MOST_SAID:]}")
