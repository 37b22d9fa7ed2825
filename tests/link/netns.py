"""Two network namespaces joined by a veth that plays a script: the kernel's own TCP on a shaped link.

Rate by tc's tbf (with the script's queue), loss by iptables' statistic match, darkness by taking the link down. The
kernel's netem is often not there, so delay, jitter and reordering are left out: `link.relay` has them. Which packets
of a random loss are lost is drawn by the kernel; bursts come from the script and its seed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
import time
from types import TracebackType
from typing import Self

from link.script import LinkState, Script

__all__ = ["GROUND_HOST", "Namespaces", "UnavailableError"]

GROUND_HOST = "10.98.0.2"
_EDGE_HOST = "10.98.0.1"
_TBF_BURST_BYTES = 3200
_RULE = ("INPUT", "-i")


class UnavailableError(Exception):
    """Namespaces are not to be had here; the text says why."""


class Namespaces:
    """One namespace for the edge, one for the ground. A context manager that removes both.

    Raises:
        UnavailableError: iproute2, iptables or the rights are missing.
    """

    def __init__(self, script: Script) -> None:
        self._script = script
        stem = f"hvt-link-{os.getpid()}-{threading.get_ident() % 10_000}"
        self.names = {"edge": f"{stem}-e", "ground": f"{stem}-g"}
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._player: threading.Thread | None = None
        self._state: LinkState | None = None

    def prefix(self, side: str) -> list[str]:
        """What goes before a command that is to run on this side (``edge`` or ``ground``)."""
        return ["ip", "netns", "exec", self.names[side]]

    def begin(self) -> float:
        """The script begins now; return the Unix time."""
        self._player = threading.Thread(target=self._play, args=(time.monotonic(),), name="link-script")
        self._player.start()
        return time.time()

    def __enter__(self) -> Self:
        for tool in ("ip", "tc", "iptables"):
            if shutil.which(tool) is None:
                raise UnavailableError(f"needs the command {tool} (iproute2, iptables)")
        try:
            self._build()
        except subprocess.CalledProcessError as error:
            self._remove()
            reason = error.stderr.strip().splitlines()
            raise UnavailableError(f"{' '.join(error.cmd)}: {reason[-1] if reason else 'failed'}") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        if self._player is not None:
            self._player.join(10)
        self._remove()
        if self._error is not None and error is None:
            raise self._error

    def _build(self) -> None:
        edge, ground = self.names["edge"], self.names["ground"]
        _run("ip", "netns", "add", edge)
        _run("ip", "netns", "add", ground)
        _run(
            *["ip", "link", "add", "veth-e", "netns"],
            edge,
            *["type", "veth", "peer", "name", "veth-g", "netns"],
            ground,
        )
        for name, end, host in ((edge, "veth-e", _EDGE_HOST), (ground, "veth-g", GROUND_HOST)):
            _run("ip", "-n", name, "address", "add", f"{host}/30", "dev", end)
            # Without this the shaper meets 64 kB super-packets, as no real link carries them.
            _run("ip", "-n", name, "link", "set", "dev", end, "gso_max_segs", "1")
            _run("ip", "-n", name, "link", "set", "lo", "up")
            _run("ip", "-n", name, "link", "set", end, "up")
            _run("ip", "netns", "exec", name, "iptables", "-A", *_RULE, end, "-j", "ACCEPT")
            _run("tc", "-n", name, "qdisc", "add", "dev", end, "root", *self._tbf(self._script.still().at(0)))
        self._state = self._script.still().at(0)

    def _remove(self) -> None:
        for name in self.names.values():
            subprocess.run(["ip", "netns", "delete", name], check=False, capture_output=True)

    def _play(self, began_s: float) -> None:
        try:
            for piece in self._script.pieces:
                if self._stop.wait(max(0.0, began_s + piece.start_s - time.monotonic())):
                    return
                self._apply(piece.state)
        except BaseException as error:  # noqa: BLE001 - raised where the namespaces are left
            self._error = error

    def _apply(self, state: LinkState) -> None:
        before, self._state = self._state, state
        assert before is not None
        ends = [(self.names["edge"], "veth-e"), (self.names["ground"], "veth-g")]
        if state.rate_bps != before.rate_bps:
            for name, end in ends:
                _run("tc", "-n", name, "qdisc", "change", "dev", end, "root", *self._tbf(state))
        if state.loss != before.loss:
            for name, end in ends:
                _run("ip", "netns", "exec", name, "iptables", "-R", _RULE[0], "1", *_lose(end, state.loss))
        if state.dark != before.dark:
            _run("ip", "-n", ends[1][0], "link", "set", ends[1][1], "down" if state.dark else "up")

    def _tbf(self, state: LinkState) -> list[str]:
        limit = self._script.queue_bytes + _TBF_BURST_BYTES
        return f"tbf rate {state.rate_bps}bit burst {_TBF_BURST_BYTES} limit {limit}".split()


def _lose(end: str, share: float) -> list[str]:
    if share <= 0:
        return ["-i", end, "-j", "ACCEPT"]
    if share >= 1:
        return ["-i", end, "-j", "DROP"]
    return ["-i", end, *f"-m statistic --mode random --probability {share:.6f} -j DROP".split()]


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=20)


def _words(text: str) -> list[str]:
    return text.split()
