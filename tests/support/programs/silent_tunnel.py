"""A tunnel whose near end goes on accepting while the line behind it is dark, as those of SSH and of proxies do."""

import socket
import threading
from contextlib import ExitStack, suppress
from typing import Self

_SOCKET_BYTES = 8192


class SilentTunnel:
    """Passes on what comes to ``port`` of loopback; a context manager.

    What is connected when the line falls dark stays open, is read no more, and never works again. What connects in
    darkness is accepted, and nothing ever comes of it.
    """

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self._open = ExitStack()
        self._listener = self._open.enter_context(socket.socket())
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)
        self._listener.bind(("127.0.0.1", 0))
        self._listener.listen()
        self.port: int = self._listener.getsockname()[1]
        self._dark = threading.Event()
        self.in_vain = 0
        """Connections that were accepted in darkness."""

    def darken(self) -> None:
        self._dark.set()

    def lighten(self) -> None:
        """It is back, for what connects from now on."""
        self._dark = threading.Event()

    def __enter__(self) -> Self:
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._dark.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._open.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                self._open.push(near)
                if self._dark.is_set():
                    self.in_vain += 1
                    continue
                far = self._open.enter_context(socket.create_connection(("127.0.0.1", self._target_port)))
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._pass_on, args=[*ends, self._dark], daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket, dark: threading.Event) -> None:
        with suppress(OSError):
            while (data := source.recv(_SOCKET_BYTES)) and not dark.is_set():
                sink.sendall(data)
            if not dark.is_set():
                sink.shutdown(socket.SHUT_WR)
