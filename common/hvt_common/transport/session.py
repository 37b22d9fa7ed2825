"""HVT's Zenoh session: opening it, publishers, subscribers, queries.

Peers connect to named endpoints only: no multicast, no gossip, no shared memory (byte counts would be wrong),
loopback by default. Callbacks of Zenoh never block: they copy into an `Inbox`, which has a bound.
"""

import json
import logging
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue

import zenoh

from hvt_common.errors import NotYetError, UserError
from hvt_common.protocol.channels import DELIVERIES, MSGPACK_ENCODING, Channel, EdgeKeys
from hvt_common.runtime.failures import Awaited, Failures
from hvt_common.transport.inbox import Received
from hvt_common.transport.link_doctor import link_doctor
from hvt_common.transport.own_sockets import is_listening, own_sockets
from hvt_common.transport.zenoh_config import LinkSettings, configure, without_build_paths

_log = logging.getLogger(__name__)

_CLOSE_WITHIN_S = 0.8
_OTHERS_S = 0.3
"""After the first answer to a question others have this time."""
_MAY_COME = re.compile(
    "Cannot assign requested address|Address already in use|No such device|Network is (unreachable|down)"
    "|failed to lookup address"
)
"""Zenoh's messages for an address that is not there yet, or not free."""


@contextmanager
def open_session(
    settings: LinkSettings, *, failures: Failures | None = None, on_deaf: Callable[[], None] | None = None
) -> Iterator[zenoh.Session]:
    """A running session; closed within a second on the way out, whatever state the link is in.

    A connecting side does not wait for the other: it goes on trying for as long as the session is open. With
    ``failures`` so does a listening one whose address is not there yet or whose port is not free. ``on_deaf()`` is
    called, in a thread, once a listener hears nothing any more and only another session helps. Raises UserError for
    endpoints, files, keys and ports that cannot be used. With RUST_LOG set, Zenoh logs to stderr.
    """
    config, listen = configure(settings)
    link_doctor().check_keys(config, listen=listen, name=settings.name, now_s=time.time())
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    stop = threading.Event()
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        why = _open_failure(str(error), listen, config)
        if failures is None or not _MAY_COME.search(str(error)):
            raise UserError(why) from None
        session = _open_listening_later(config, listen, why, failures, stop)
    else:
        if failures is not None:
            failures.works("listener")
    try:
        with link_doctor().mend(session, config, failures or Failures(time.time_ns), on_deaf=on_deaf):
            yield session
    finally:
        stop.set()
        _close(session)


def _open_listening_later(
    config: zenoh.Config, listen: tuple[str, ...], why: str, failures: Failures, stop: threading.Event
) -> zenoh.Session:
    # A session that listens as soon as it can; ``failures`` learns when.
    retry = {"period_init_ms": 500, "period_max_ms": 500, "period_increase_factor": 1.0}
    for key, value in (("timeout_ms", -1), ("exit_on_failure", False), ("retry", retry)):
        config.insert_json5(f"listen/{key}", json.dumps(value))
    before = own_sockets()  # the page of this program may have the very port
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise UserError(_open_failure(str(error), listen, config)) from None

    wanted = [endpoint for endpoint in listen if re.search(r":[1-9]\d*([?#]|$)", endpoint)]

    def bound() -> bool:
        if not is_listening(wanted, before=before):
            raise NotYetError(why)
        return True

    part = Awaited(bound, "listener", failures, longest_s=1.0)
    threading.Thread(target=part.wait, args=[stop], name="hvt-listen", daemon=True).start()
    return session


def loses_declarations(settings: LinkSettings, session: zenoh.Session) -> Callable[[], bool]:
    """Whether a declaration may be lost on its way now: over UDP, here or, for all that is known, behind a router.

    Zenoh makes each once, so its owner makes it again, as `another_key` says. Not over TLS and QUIC: rights name
    whole keys, so a key that one may use would be withdrawn for one that one may not.
    """
    config = configure(settings)[0]
    ends = "".join(str(config.get_json(f"{side}/endpoints")) for side in ("connect", "listen"))
    if '"udp/' in ends:
        return lambda: True
    secret = '"tls/' in ends or '"quic/' in ends
    return lambda: not secret and bool(session.info.routers_zid())


def another_key(key: str, channel: Channel, *, number: int) -> str:
    """An expression that meets that key of this channel alone, for the ``number``-th declaration after the first.

    Zenoh gives a key its number once: where that datagram is lost, the same key is never understood again.
    """
    at = len(key) - number % (len(channel) + 1)
    return f"{key[:at]}$*{key[at:]}" if number else key


def declare_publisher(session: zenoh.Session, channel: Channel, *, keys: EdgeKeys) -> zenoh.Publisher:
    """A publisher of one channel, delivered as the key table says; ``put`` may block on a ``BLOCK`` channel."""
    delivery = DELIVERIES[channel]
    return session.declare_publisher(
        keys[channel],
        encoding=delivery.encoding,
        congestion_control=getattr(zenoh.CongestionControl, delivery.congestion),
        priority=getattr(zenoh.Priority, delivery.priority),
        express=False,  # sending without batching makes loss worse on a saturated link
        reliability=zenoh.Reliability.RELIABLE,
    )


def subscribe(
    session: zenoh.Session,
    key_expr: str,
    *,
    put: Callable[[Received], None],
    clock: Callable[[], int] = time.time_ns,
    on_error: Callable[[str, Exception], None] | None = None,
) -> zenoh.Subscriber[None]:
    """``put``, which never blocks, gets every message of the key expression with its time by ``clock``; no deletions.

    ``on_error(key, error)`` gets the exception of a message, which Zenoh would print and forget.
    """

    def receive(sample: zenoh.Sample) -> None:
        key, attachment = str(sample.key_expr), sample.attachment
        try:
            received_ns = clock()
            if sample.kind != zenoh.SampleKind.PUT:
                return
            extra = b"" if attachment is None else attachment.to_bytes()
            put(Received(key, sample.payload.to_bytes(), extra, str(sample.encoding), received_ns))
        except Exception as error:
            if on_error is None:
                raise
            on_error(key, error)

    return session.declare_subscriber(key_expr, receive)


def query(
    session: zenoh.Session,
    channel: Channel,
    *,
    keys: EdgeKeys,
    question: bytes,
    timeout_s: float,
    is_last: Callable[[bytes], bool] | None = None,
) -> list[bytes]:
    """The answers of a queryable channel; none when there is none in time, after ``timeout_s``.

    There are several where several edges have one name. After the first the others have 0.3 s, or, with ``is_last``,
    until it accepts one. Over UDP a question or its answer may be lost: after half of the time it is asked once more,
    so it must be a question that is safe to ask twice.
    """
    found: SimpleQueue[bytes | None] = SimpleQueue()
    answers: list[bytes] = []
    open_questions = 0
    for within_s in (timeout_s, timeout_s / 2):
        query_later(
            session,
            channel,
            keys=keys,
            question=question,
            timeout_s=within_s,
            on_answer=found.put,
            on_end=lambda: found.put(None),
        )
        open_questions += 1
        until_s = time.monotonic() + timeout_s / 2
        with suppress(Empty):
            while open_questions:
                answer = found.get(timeout=max(0.0, until_s - time.monotonic()))
                if answer is None:
                    open_questions -= 1
                    continue
                answers.append(answer)
                if is_last is not None and is_last(answer):
                    return answers
                if is_last is None and len(answers) == 1:
                    until_s = time.monotonic() + _OTHERS_S
        if not open_questions or (answers and is_last is None):
            break
    return answers


def query_later(
    session: zenoh.Session,
    channel: Channel,
    *,
    keys: EdgeKeys,
    question: bytes,
    timeout_s: float,
    on_answer: Callable[[bytes], None],
    on_end: Callable[[], None],
) -> None:
    """Ask without waiting: ``on_answer`` gets each answer, ``on_end`` is called after the last or in the end.

    Both run in Zenoh's callbacks.
    """

    def reply(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            on_answer(reply.ok.payload.to_bytes())

    handler: zenoh.handlers.Callback[zenoh.Reply] = zenoh.handlers.Callback(reply, on_end)
    delivery = DELIVERIES[channel]
    session.get(
        keys[channel],
        handler,
        payload=question,
        timeout=timeout_s,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=getattr(zenoh.CongestionControl, delivery.congestion),
        priority=getattr(zenoh.Priority, delivery.priority),
    )


def serve(
    session: zenoh.Session,
    channel: Channel,
    *,
    keys: EdgeKeys,
    answer: Callable[[bytes], bytes | None],
    declared_as: str | None = None,
) -> zenoh.Queryable[None]:
    """Answer a queryable channel; ``answer(question)`` runs in Zenoh's callback, must be quick, and may give None.

    ``declared_as`` is another expression for its key.
    """
    key = keys[channel]

    def reply(query: zenoh.Query) -> None:
        with query:
            question = b"" if query.payload is None else query.payload.to_bytes()
            data = answer(question)
            if data is not None:
                query.reply(key, data, encoding=MSGPACK_ENCODING)

    return session.declare_queryable(declared_as or key, reply)


def _open_failure(text: str, listen: tuple[str, ...], config: zenoh.Config) -> str:
    found = re.search(r"listener bound to ([^\s#]+?)(#\S+)?:? ", text)
    endpoint = found[1] if found else ", ".join(listen)
    if "Address already in use" in text:
        return (
            f"cannot listen on {endpoint}: the port is in use; stop the other process or choose another port"
        )
    if "Cannot assign requested address" in text:
        return f"cannot listen on {endpoint}: this machine has no such address"
    if "No such device" in text:
        return f"cannot listen on {', '.join(listen)}: this machine has no such interface"
    if nobody := re.search(r"Unable to connect to any of \[(.+)\]", text):
        endpoints = ", ".join(re.findall(r"\(([^()]+)\)", nobody[1])) or nobody[1]
        # With TLS the other side may answer, and refuse.
        if "tls/" in endpoints and (why := link_doctor().why_no_link(config)):
            return "no link: " + "; ".join(why)
        return f"nobody answers at {endpoints}: start a ground or a router there, or connect to where one is"
    where = f"cannot listen on {endpoint}" if listen else "cannot open the Zenoh session"
    return f"{where}: {without_build_paths(text)}"


def _close(session: zenoh.Session) -> None:
    # Close without waiting for a link that is dead: Zenoh itself may take 10 s when its queue is stuck.
    if sys.is_finalizing():  # nobody has left the session, and a thread that begins now never does
        return

    def close() -> None:
        with suppress(zenoh.ZError):
            session.close()  # type: ignore[no-untyped-call]

    closer = threading.Thread(target=close, name="zenoh-close", daemon=True)
    closer.start()
    closer.join(_CLOSE_WITHIN_S)
    if closer.is_alive():
        _log.warning("the link does not react; leaving without a goodbye")
