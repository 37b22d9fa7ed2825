"""Finds refused connections to our listening ports: Zenoh closes such a connection and says nothing of it.

The kernel's table of TCP connections (/proc/net/tcp, Linux only) has who connects now. A connection that ends and
never was one of the session's links was refused: no certificate, one of another CA, or no Zenoh at all. From a host
that has had a link it is taken for one of its own that broke off, as in an outage: who is known there is no stranger.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path

from hvt_common.runtime.statistics import Newest
from hvt_common.transport.own_sockets import TCP_TABLES
from hvt_fleet.link.stale_sockets import connections

_TIMES, _WITHIN_S = 3, 600.0
"""Who is refused tries again each second, and on a quick link is seen now and then only."""
_AGAIN_S = 60.0
_MOST_HOSTS = 256
_COUNTERS = Path("/proc/self/net/snmp")


def _accepted() -> int:
    # TCP connections that anybody here has accepted so far; IPv6 included.
    names, values = re.findall(r"^Tcp: (.*)$", _COUNTERS.read_text(encoding="ascii"), re.MULTILINE)
    return int(dict(zip(names.split(), values.split(), strict=True))["PassiveOpens"])


class Strangers:
    """``ports`` are those that we listen on. For one thread; check several times a second.

    The table is read while somebody is pending, and where a connection was accepted since: it takes 4 ms.
    """

    def __init__(
        self,
        ports: Iterable[int],
        *,
        tables: Iterable[Path] = TCP_TABLES,
        accepted: Callable[[], int] = _accepted,
    ) -> None:
        self._ports = frozenset(ports)
        self._tables = [one for one in tables if one.exists()] if self._ports else []
        self._accepted, self._accepted_before = accepted, -1
        self._linked: set[str] = set()
        """Connections that are links, or were."""
        self._pending: set[str] = set()
        """Connections that are no links, or not yet."""
        self._known: Newest[str, None] = Newest(_MOST_HOSTS)
        """Hosts that have had a link, the last ones."""
        self._refused: Newest[str, list[float]] = Newest(_MOST_HOSTS)
        """Host → when its connections ended, the last ones."""
        self._said_s: Newest[str, float] = Newest(_MOST_HOSTS)

    def note_links(self, far_ends: Iterable[str]) -> None:
        """These have a link, or had one a moment ago, however short: `check` may see neither."""
        for end in far_ends:
            host, _, port = end.rpartition(":")
            if port.isdigit() and int(port) in self._ports:
                continue  # our own end
            self._known.put(host, None)

    def check(self, links: Callable[[], Iterable[str]], now_s: float) -> list[str]:
        """Return the hosts to be named now; ``links`` gives the far ends of the links that stand."""
        accepted = self._accepted() if self._tables else -1
        if accepted == self._accepted_before and not self._pending:
            return []
        self._accepted_before = accepted
        here = (one for table in self._tables for one in connections(table))
        connected = {one.theirs for one in here if int(one.ours.rpartition(":")[2]) in self._ports}
        if connected <= self._linked and not self._pending:
            self._linked = connected
            return []
        linked = set(links())
        self.note_links(linked & connected)
        ended = self._pending - connected - linked
        # The kernel goes on with the connection of a link that was lost: that was one all the same.
        self._linked = connected & (linked | self._linked)
        self._pending = connected - self._linked
        hosts = [far_end.rpartition(":")[0] for far_end in sorted(ended)]
        return [host for host in hosts if host not in self._known and self._note(host, now_s)]

    def _note(self, host: str, now_s: float) -> bool:
        before = (one for one in self._refused.get(host, ()) if now_s - one < _WITHIN_S)
        times = [*before, now_s][-_TIMES:]
        self._refused.put(host, times)
        if len(times) < _TIMES or now_s - self._said_s.get(host, -_AGAIN_S) < _AGAIN_S:
            return False
        self._said_s.put(host, now_s)
        return True


def listening_ports(endpoints: Iterable[str]) -> set[int]:
    """The ports of the TCP and TLS endpoints, such as ``tls/0.0.0.0:7447``."""
    found = (re.match(r"(?:tcp|tls)/.*:(\d+)(?:[?#]|$)", one) for one in endpoints)
    return {int(one[1]) for one in found if one is not None}
