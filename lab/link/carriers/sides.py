"""Network namespaces, one for the edge and one for the ground: the common base of carriers of real packets.

A carrier joins the two in `_build` and may let threads work (`_start`); whatever goes wrong, nothing is left behind.
"""

import os
import secrets
import shutil
import subprocess
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar, Self

EDGE_HOST = "10.98.0.1"
GROUND_HOST = "10.98.0.2"
_CONGESTION_CONTROL = Path("/proc/sys/net/ipv4/tcp_congestion_control")


class UnavailableError(Exception):
    """Namespaces are not to be had here; the text says why."""


class Sides:
    """One namespace for the edge, one for the ground, unless others are named. A context manager that removes them.

    Attributes:
        names: of the namespaces, by side.

    Raises:
        UnavailableError: a command, a device or the rights are missing.
    """

    _needs: ClassVar[tuple[str, ...]] = ("ip",)
    """The commands without which it cannot be."""

    def __init__(self, names: Mapping[str, str] | None = None) -> None:
        self._token = secrets.token_hex(3)
        stem = f"hvt-link-{os.getpid()}-{self._token}"
        self.names = names or {"edge": f"{stem}-e", "ground": f"{stem}-g"}
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._worker: threading.Thread | None = None

    def prefix(self, side: str) -> list[str]:
        """The words before a command that is to run on this side."""
        return ["ip", "netns", "exec", self.names[side]]

    def begin(self) -> float:
        """The script begins now; return the Unix time."""
        raise NotImplementedError

    def _build(self) -> None:
        """Join the namespaces, which are there and empty."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        for tool in self._needs:
            if shutil.which(tool) is None:
                raise UnavailableError(f"needs the command {tool} (iproute2, iptables)")
        try:
            for name in self.names.values():
                command("ip", "netns", "add", name)
                command("ip", "-n", name, "link", "set", "lo", "up")
            self._build()
        except subprocess.CalledProcessError as error:
            self._leave()
            reason = error.stderr.strip().splitlines()
            raise UnavailableError(f"{' '.join(error.cmd)}: {reason[-1] if reason else 'failed'}") from None
        except OSError as error:
            self._leave()
            raise UnavailableError(str(error)) from None
        except BaseException:
            self._leave()
            raise
        return self

    def __exit__(self, _kind: object, error: object, _trace: object) -> None:
        self._leave()
        if self._error is not None and error is None:
            raise self._error

    def _leave(self) -> None:
        self._stop.set()
        if self._worker is not None:
            self._worker.join(10)
        for name in self.names.values():
            subprocess.run(["ip", "netns", "delete", name], check=False, capture_output=True)

    def _start(self, work: Callable[[], None], *, name: str) -> None:
        """Work in a thread until `_stop`; its exception is raised where the sides are left."""

        def guarded() -> None:
            try:
                work()
            except BaseException as error:  # noqa: BLE001 - raised where the sides are left
                self._error = error

        self._worker = threading.Thread(target=guarded, name=name)
        self._worker.start()


def command(*words: str) -> None:
    """Run a command.

    Raises:
        subprocess.CalledProcessError: it failed; ``stderr`` says why.
    """
    subprocess.run(words, check=True, capture_output=True, text=True, timeout=20)


def congestion_control() -> str:
    """By which rule the kernel's TCP paces itself; a new namespace has the machine's."""
    try:
        return _CONGESTION_CONTROL.read_text().strip()
    except OSError:
        return "unknown"
