"""Two network namespaces joined by a veth that plays a script: the kernel's own TCP on a shaped link.

Rate by tc's tbf (with the script's queue), loss by iptables' statistic match, darkness by taking the link down. The
kernel's netem is often not there, so delay, jitter and reordering are left out: `tunnel` has them. Which packets of a
random loss are lost is drawn by the kernel; bursts come from the script and its seed.
"""

import time

from lab.link.carriers.sides import EDGE_HOST, GROUND_HOST, Sides, command
from lab.link.timeline import LinkState, Script

_TBF_BURST_BYTES = 3200
_RULE = ("INPUT", "-i")


class Namespaces(Sides):
    """The namespaces of edge and ground, joined by a veth. A context manager that removes them.

    Raises:
        UnavailableError: iproute2, iptables or the rights are missing.
    """

    _needs = ("ip", "tc", "iptables")

    def __init__(self, script: Script) -> None:
        super().__init__()
        self._script = script
        self._state: LinkState | None = None

    def begin(self) -> float:
        """The script begins now; return the Unix time."""
        began_s = time.monotonic()
        self._start(lambda: self._play(began_s), name="link-script")
        return time.time()

    def _build(self) -> None:
        edge, ground, first = self.names["edge"], self.names["ground"], self._script.still().at(0)
        peer = ("type", "veth", "peer", "name", "veth-g", "netns", ground)
        command("ip", "link", "add", "veth-e", "netns", edge, *peer)
        for name, end, host in ((edge, "veth-e", EDGE_HOST), (ground, "veth-g", GROUND_HOST)):
            command("ip", "-n", name, "address", "add", f"{host}/30", "dev", end)
            # Without this the shaper meets 64 kB super-packets, as no real link carries them.
            command("ip", "-n", name, "link", "set", "dev", end, "gso_max_segs", "1")
            command("ip", "-n", name, "link", "set", end, "up")
            command("ip", "netns", "exec", name, "iptables", "-A", *_RULE, end, "-j", "ACCEPT")
            command("tc", "-n", name, "qdisc", "add", "dev", end, "root", *self._tbf(first))
        self._state = first

    def _play(self, began_s: float) -> None:
        for phase in self._script.phases:
            if self._stop.wait(max(0.0, began_s + phase.start_s - time.monotonic())):
                return
            self._apply(phase.state)

    def _apply(self, state: LinkState) -> None:
        before, self._state = self._state, state
        assert before is not None
        ends = [(self.names["edge"], "veth-e"), (self.names["ground"], "veth-g")]
        if state.rate_bps != before.rate_bps:
            for name, end in ends:
                command("tc", "-n", name, "qdisc", "change", "dev", end, "root", *self._tbf(state))
        if state.loss != before.loss:
            for name, end in ends:
                command("ip", "netns", "exec", name, "iptables", "-R", _RULE[0], "1", *_lose(end, state.loss))
        if state.dark != before.dark:
            command("ip", "-n", ends[1][0], "link", "set", ends[1][1], "down" if state.dark else "up")

    def _tbf(self, state: LinkState) -> list[str]:
        limit = self._script.queue_bytes + _TBF_BURST_BYTES
        return f"tbf rate {state.rate_bps}bit burst {_TBF_BURST_BYTES} limit {limit}".split()


def _lose(end: str, share: float) -> list[str]:
    if share <= 0:
        return ["-i", end, "-j", "ACCEPT"]
    if share >= 1:
        return ["-i", end, "-j", "DROP"]
    return ["-i", end, *f"-m statistic --mode random --probability {share:.6f} -j DROP".split()]
