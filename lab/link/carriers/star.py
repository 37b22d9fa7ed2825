"""Network namespaces around one in the middle: a router, and hosts that each have a link of their own to it."""

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from lab.link.carriers.sides import Sides, command

_ROUTER = "router"


class Star(Sides):
    """A namespace for each of ``hosts``, and one for the router that joins them by a bridge. A context manager.

    Attributes:
        address: of each host and of ``router``.

    Raises:
        UnavailableError: iproute2 or the rights are missing.
    """

    within = Sides.prefix

    def __init__(self, hosts: Sequence[str]) -> None:
        everybody = (_ROUTER, *hosts)
        super().__init__({host: f"hvt-star-{os.getpid()}-{host}" for host in everybody})
        self.address = {host: f"10.97.0.{number}" for number, host in enumerate(everybody, start=1)}

    def set_link(self, host: str, *, down: bool) -> None:
        command("ip", "-n", self.names[_ROUTER], "link", "set", host, "down" if down else "up")

    def line_bytes(self, host: str) -> int:
        """All that its link has carried, both ways, with the headers of Ethernet."""
        counters = Path("/sys/class/net") / host / "statistics"
        words = [*self.within(_ROUTER), "cat", str(counters / "rx_bytes"), str(counters / "tx_bytes")]
        return sum(map(int, subprocess.check_output(words, text=True).split()))

    def _build(self) -> None:
        router = self.names[_ROUTER]
        command("ip", "-n", router, "link", "add", "bridge", "type", "bridge")
        command("ip", "-n", router, "link", "set", "bridge", "up")
        command("ip", "-n", router, "address", "add", f"{self.address[_ROUTER]}/24", "dev", "bridge")
        for host, name in self.names.items():
            if host != _ROUTER:
                ends = ("type", "veth", "peer", "name", "uplink", "netns", name)
                command("ip", "-n", router, "link", "add", host, *ends)
                command("ip", "-n", router, "link", "set", host, "master", "bridge", "up")
                command("ip", "-n", name, "address", "add", f"{self.address[host]}/24", "dev", "uplink")
                command("ip", "-n", name, "link", "set", "uplink", "up")
