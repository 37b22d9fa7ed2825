"""The log of a program: lines for people, or one JSON object a line for programs."""

from __future__ import annotations

import json
import logging
import logging.handlers
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from types import MappingProxyType, TracebackType
from typing import Any

from hvt_common.errors import FlightError, UserError
from hvt_common.redaction import Redaction
from hvt_common.runtime import failures
from hvt_common.units import shown_text

LOG_FORMATS = ("text", "json")
STATUS_LOGGER = "hvt.status"
"""Logger of lines that go to the status line in text form, and to the log in JSON alone."""

START_LOGGER = "hvt.start"
"""Findings at the start that are no warning; not with ``quiet``."""

_fields: ContextVar[Mapping[str, str]] = ContextVar("hvt_log_fields", default=MappingProxyType({}))


def log_fields(**fields: str) -> None:
    """Name the subject of all further lines of this thread, such as ``edge``; empty for nothing."""
    _fields.set({name: value for name, value in {**_fields.get(), **fields}.items() if value})


def start_log(
    program: str, *, quiet: bool, form: str = "text", redaction: Redaction | None = None, **fields: str
) -> Log:
    """Buffer the log until `Log.release`, then write it to stderr. So a start that fails says one sentence.

    Unless ``quiet``, the provider of each network and other findings of the start are logged, and with
    ``form="json"`` a line of status now and then.
    Every JSON line holds ``fields``. No line or traceback holds a secret that ``redaction`` hides.
    """
    stream = logging.StreamHandler()
    as_json = form == "json"
    redaction = redaction or Redaction()
    stream.setFormatter(
        _JsonFormatter(program, fields, redaction) if as_json else _TextFormatter(program, redaction)
    )
    held = _HeldLog(stream)
    held.addFilter(_with_fields)
    logging.basicConfig(level=logging.WARNING, handlers=[held], force=True)
    for name in ("hvt_common.inference.runtimes.model", START_LOGGER, *((STATUS_LOGGER,) if as_json else ())):
        logging.getLogger(name).setLevel(logging.WARNING if quiet else logging.INFO)
    log = Log(program, held, as_json=as_json, redaction=redaction)
    if as_json:
        logging.captureWarnings(capture=True)
    sys.excepthook = log.crashed
    threading.excepthook = lambda args: log.crashed(
        args.exc_type, args.exc_value or args.exc_type(), args.exc_traceback
    )
    return log


class Log:
    """The log that `start_log` began."""

    def __init__(self, program: str, held: _HeldLog, *, as_json: bool, redaction: Redaction) -> None:
        self._logger = logging.getLogger(program)
        self._held = held
        self.redaction = redaction
        self.as_json = as_json
        """One JSON object a line."""

    def release(self) -> None:
        """Write the buffer, and from now on each line at once."""
        self._held.say_on()

    def result(self, content: Any) -> None:
        self._write(logging.INFO, "ended", hvt_content={"summary": content})

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Within it a sentence that ends the program is one JSON line; the buffer is then discarded."""
        try:
            yield
        except (UserError, FlightError) as error:
            error.args = (self.redaction.text(str(error)),)
            if self.as_json:
                self._write(logging.ERROR, str(error))
                error.said = True
            raise

    def crashed(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        """A bug: its traceback, with JSON as one line."""
        self.release()
        self._logger.critical("%s: %s", kind.__name__, error, exc_info=(kind, error, trace))

    def _write(self, level: int, message: str, **extra: Any) -> None:
        # Write past the buffer.
        record = self._logger.makeRecord(
            self._logger.name, level, __file__, 0, message, (), None, extra=extra
        )
        self._held.target.handle(record)


class _HeldLog(logging.handlers.MemoryHandler):
    # Buffers records until `say_on`; without it they are discarded.

    target: logging.Handler

    def __init__(self, target: logging.Handler) -> None:
        super().__init__(10_000, target=target, flushOnClose=False)
        self._free = False

    def say_on(self) -> None:
        """Write the buffered records, and from now on each at once."""
        self._free = True
        self.flush()

    def emit(self, record: logging.LogRecord) -> None:
        """A wait at the start is logged at once: it may take hours."""
        if self._free or record.name != failures.__name__:
            super().emit(record)
        else:
            self.target.handle(record)

    def shouldFlush(self, record: logging.LogRecord) -> bool:  # noqa: ARG002, N802 - the library's name
        return self._free

    def flush(self) -> None:
        """Discard the buffer at exit: logging itself would write it."""
        if self._free:
            super().flush()


def _with_fields(record: logging.LogRecord) -> bool:
    # In the thread that logs: a line that is buffered may be written by another.
    record.hvt_fields = _fields.get()
    return True


class _TextFormatter(logging.Formatter):
    def __init__(self, program: str, redaction: Redaction) -> None:
        super().__init__(f"{program}: %(message)s")
        self._redaction = redaction

    def format(self, record: logging.LogRecord) -> str:
        return shown_text(self._redaction.text(super().format(record)))


class _JsonFormatter(logging.Formatter):
    # ``time`` (ISO 8601, UTC), ``level``, ``program``, ``logger``, ``message``, the subject, ``traceback``.

    def __init__(self, program: str, fields: Mapping[str, str], redaction: Redaction) -> None:
        super().__init__()
        self._redaction = redaction
        self._program = program
        self._fields = dict(fields)

    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created, UTC)
        line = {
            "time": at.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "program": self._program,
            "logger": record.name,
            "message": record.getMessage(),
            **self._fields,
            **getattr(record, "hvt_fields", {}),
            **getattr(record, "hvt_content", {}),
        }
        if record.exc_info and record.exc_info[0] is not None:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(self._redaction.value(line), ensure_ascii=False, default=str)
