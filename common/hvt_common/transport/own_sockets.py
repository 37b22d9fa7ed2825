"""The sockets of this process as Linux tells them; Zenoh does not."""

import ipaddress
import os
import socket
import stat
import struct
from collections.abc import Container, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from hvt_common.transport.zenoh_config import end_of, host_of

TCP_TABLES = (Path("/proc/self/net/tcp"), Path("/proc/self/net/tcp6"))
_UDP_TABLES = (Path("/proc/self/net/udp"), Path("/proc/self/net/udp6"))
LISTENING = "0A"
"""The kernel's word for it in these tables, which Linux alone has."""


def is_listening(endpoints: Iterable[str], *, before: Container[int]) -> bool:
    """Whether sockets of this process listen, or take datagrams, at each of these endpoints of Zenoh.

    Linux says it: Zenoh does not say when its listener has come. Inodes of ``before`` are of other parts.
    """
    own = {inode for inode in own_sockets() if inode not in before}
    here = {end for end, state in _ends(TCP_TABLES, own) if state == LISTENING}
    here |= {end for end, _ in _ends(_UDP_TABLES, own)}
    return all(here & ends_of(end_of(one)) for one in endpoints)


def _ends(tables: Iterable[Path], own: Container[int]) -> Iterator[tuple[str, str]]:
    # End and state of each of these sockets.
    for table in tables:
        with suppress(OSError):  # a kernel without IPv6
            for line in table.read_text(encoding="ascii").splitlines()[1:]:
                _, ours, _, state, *_, inode = line.split(maxsplit=10)[:10]
                if int(inode) in own:
                    yield end_in_table(ours), state


def ends_of(end: str) -> set[str]:
    """All that an end stands for, whose host may be a name; nothing where nobody knows it."""
    host, _, port = end.rpartition(":")
    with suppress(OSError, UnicodeError):
        found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
        return {end_of_name(one[4]) for one in found}
    return set()


def own_sockets() -> dict[int, int]:
    """Inode → descriptor, of this process."""
    found = {}
    for one in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # closed meanwhile
            status = os.fstat(int(one.name))
            if stat.S_ISSOCK(status.st_mode):
                found[status.st_ino] = int(one.name)
    return found


def end_in_table(text: str) -> str:
    """The end that the kernel writes as words of four bytes, in the machine's own order."""
    address, _, port = text.rpartition(":")
    words = [int(address[at : at + 8], 16) for at in range(0, len(address), 8)]
    return f"{host_of(ipaddress.ip_address(struct.pack(f'={len(words)}I', *words)))}:{int(port, 16)}"


def end_of_name(name: tuple[Any, ...]) -> str:
    """The end of a socket's name."""
    return f"{host_of(ipaddress.ip_address(name[0].partition('%')[0]))}:{name[1]}"
