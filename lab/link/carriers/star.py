"""Network namespaces around one in the middle: a router, and hosts that each have a link of their own to it."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from lab.link.carriers.sides import UnavailableError, command

_ROUTER = "router"


class Star:
    """A namespace for each of ``hosts``, and one for the router that joins them by a bridge. A context manager.

    Attributes:
        address: of each host and of ``router``.

    Raises:
        UnavailableError: iproute2 or the rights are missing.
    """

    def __init__(self, hosts: Sequence[str]) -> None:
        self._hosts = tuple(hosts)
        everybody = (_ROUTER, *self._hosts)
        self.address = {host: f"10.97.0.{number}" for number, host in enumerate(everybody, start=1)}
        self._names = {host: f"hvt-star-{os.getpid()}-{host}" for host in everybody}

    def within(self, host: str) -> list[str]:
        """The words before a command that runs there."""
        return ["ip", "netns", "exec", self._names[host]]

    def set_link(self, host: str, *, down: bool) -> None:
        """Take its link down, or up again."""
        command("ip", "-n", self._names[_ROUTER], "link", "set", host, "down" if down else "up")

    def line_bytes(self, host: str) -> int:
        """All that its link has carried, both ways, with the headers of Ethernet."""
        counters = Path("/sys/class/net") / host / "statistics"
        words = [*self.within(_ROUTER), "cat", str(counters / "rx_bytes"), str(counters / "tx_bytes")]
        return sum(map(int, subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()))

    def __enter__(self) -> Self:
        try:
            self._build()
        except subprocess.CalledProcessError as error:
            self._leave()
            raise UnavailableError(f"may not make network namespaces: {error.stderr.strip()}") from None
        except OSError as error:
            self._leave()
            raise UnavailableError(f"needs the ip command of iproute2 ({error.strerror})") from None
        except BaseException:
            self._leave()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leave()

    def _build(self) -> None:
        router = self._names[_ROUTER]
        for name in self._names.values():
            command("ip", "netns", "add", name)
            command("ip", "-n", name, "link", "set", "lo", "up")
        command("ip", "-n", router, "link", "add", "bridge", "type", "bridge")
        command("ip", "-n", router, "link", "set", "bridge", "up")
        command("ip", "-n", router, "address", "add", f"{self.address[_ROUTER]}/24", "dev", "bridge")
        for host in self._hosts:
            name = self._names[host]
            ends = ("type", "veth", "peer", "name", "uplink", "netns", name)
            command("ip", "-n", router, "link", "add", host, *ends)
            command("ip", "-n", router, "link", "set", host, "master", "bridge", "up")
            command("ip", "-n", name, "address", "add", f"{self.address[host]}/24", "dev", "uplink")
            command("ip", "-n", name, "link", "set", "uplink", "up")

    def _leave(self) -> None:
        for name in self._names.values():
            subprocess.run(["ip", "netns", "delete", name], check=False, capture_output=True)
