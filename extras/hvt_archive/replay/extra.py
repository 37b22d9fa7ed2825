"""The settings of the log of messages, and how the ground comes to write it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING

from hvt_common.config import BYTES, PATH, Group
from hvt_common.errors import UserError
from hvt_ground.config import GroundConfig, Written
from hvt_ground.extras import Extra, Service

if TYPE_CHECKING:  # ``--help`` is to open no log
    from hvt_archive.replay.message_log import MessageLog
    from hvt_common.runtime.failures import Failures
    from hvt_common.transport.inbox import Received
    from hvt_ground.control import EdgeClient
    from hvt_ground.sinks import QueuedSink

LEAST_LOG_BYTES = 20_000_000
"""Twice the largest message that there is, and room for a flight between."""
_LOG = Group("log of messages")
_END_S = 8.0


@dataclass(frozen=True)
class LogOptions(GroundConfig):
    """The settings of ``hvt-ground`` for it."""

    log: Path | None = _LOG.option(
        PATH, None, "also keep every message as it came, for hvt-ground replay: FILE.hvtlog"
    )
    log_size: int = replace(_LOG, rare=True).option(
        BYTES, 4_000_000_000, "how large the log may become: then its older half makes room"
    )


class LogExtra(Extra[LogOptions]):
    """One log for all edges."""

    options = LogOptions

    def check(self, config: LogOptions) -> None:
        if config.log_size < LEAST_LOG_BYTES:
            raise UserError(
                f"--log-size {config.log_size} bytes is not accepted: give at least {LEAST_LOG_BYTES // 10**6}MB"
            )

    def writes(self, config: LogOptions) -> Iterable[Written]:
        if config.log is not None:
            yield Written("--log", config.log, "", f"-before{escape(config.log.suffix)}")

    def serve(self, config: LogOptions, *, clock: Callable[[], int], failures: Failures) -> Service | None:  # noqa: ARG002
        if config.log is None:
            return None
        return _Logging(config.log, most_bytes=config.log_size, failures=failures)


class _Logging(Service):
    def __init__(self, path: Path, *, most_bytes: int, failures: Failures) -> None:
        self._path, self._most_bytes, self._failures = path, most_bytes, failures
        self._taken: set[Path] = set()
        self._sink: QueuedSink[Received] | None = None

    def begin(self, client: EdgeClient) -> None:  # noqa: ARG002 - no edge is asked
        from hvt_ground.sinks import QueuedSink  # noqa: PLC0415

        self._sink = QueuedSink("message log", self._open, failures=self._failures)
        self.message_log = self._sink.log

    def __exit__(self, *_: object) -> None:
        if self._sink is not None:
            self._sink.join(_END_S)

    def _open(self) -> MessageLog:
        from hvt_archive.replay.message_log import MessageLog  # noqa: PLC0415
        from hvt_ground.wiring.sessions import open_again  # noqa: PLC0415

        return open_again(self._path, self._taken, partial(MessageLog, most_bytes=self._most_bytes))
