"""A third party on the link, for tests: plain Zenoh, with nothing of HVT but the names of the keys."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import zenoh


@dataclass(frozen=True)
class Message:
    """What came under one key."""

    key: str
    payload: bytes
    attachment: bytes
    received_s: float
    """Unix time."""


@contextmanager
def joined(*endpoints: str) -> Iterator[zenoh.Session]:
    """A Zenoh session that connects to the endpoints, and goes on trying until somebody listens there."""
    config = zenoh.Config()
    for path, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "listen/endpoints": [],
        "connect/endpoints": list(endpoints),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 50, "period_increase_factor": 1},
    }.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


class Tap:
    """Keeps every message of a key expression, in order of arrival."""

    def __init__(self, session: zenoh.Session, key_expr: str) -> None:
        self._lock = threading.Lock()
        self._messages: list[Message] = []
        self._subscriber = session.declare_subscriber(key_expr, self._take)

    @property
    def messages(self) -> list[Message]:
        with self._lock:
            return list(self._messages)

    def _take(self, sample: zenoh.Sample) -> None:
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        message = Message(str(sample.key_expr), sample.payload.to_bytes(), attachment, time.time())
        with self._lock:
            self._messages.append(message)


def answer(
    session: zenoh.Session, key: str, question: bytes = b"", *, timeout_s: float = 1.0
) -> bytes | None:
    """The first answer of a queryable; None where nobody answers in time."""
    for reply in session.get(key, payload=question, timeout=timeout_s):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
    return None
