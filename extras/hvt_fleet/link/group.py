"""Grounds that share a fleet: each edge is served by one of them, and by another once that one is gone.

Who serves an edge follows from the names alone, by rendezvous hashing (Thaler and Ravishankar, 1998): the member with
the highest hash of edge and member. When a member leaves, only its own edges move. Members, and the edges that each
claims, are liveliness tokens: Zenoh takes them away with the member's link. A member says where its page is to others
that ask.
"""

from __future__ import annotations

import hashlib
import logging
import re
import secrets
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import Self

import zenoh

from hvt_common.protocol.channels import GroupKeys
from hvt_common.transport.inbox import TokenBucket
from hvt_common.units import SECOND_NS
from hvt_ground.session.subscribe import Elsewhere, Group

_log = logging.getLogger(__name__)

_JOIN_S = 1.5
"""After its start a member claims nothing meanwhile: it learns of the others."""
_SETTLE_S = 0.3
"""Between a claim and serving: another claim of the same moment is seen by then."""
_PASS_S = 10.0
"""A member that has not claimed its edge by then does not accept it: the others share it without that one."""
_MOST_PAGE_BYTES = 512
_ANSWER_S = 5.0
_MOST_MEMBERS, _MOST_EDGES, _MOST_CLAIMS = 1024, 16384, 64
"""The last of one edge: tokens may be anybody's where there are no keys."""
_BURST, _EVERY_NS = 60, SECOND_NS
"""Up to 60 comings and goings are logged at once, then one a second."""


def owner_of(edge: str, members: Iterable[str]) -> str:
    """The member that serves the edge, the same to all members."""

    def weight(member: str) -> bytes:
        return hashlib.blake2b(f"{edge}/{member}".encode(), digest_size=16).digest()

    return max(members, key=lambda member: (weight(member), member))


def member_name() -> str:
    """The name of this machine and process, such as ``base-3fa2``."""
    host = re.sub(r"[^a-z0-9-]+", "-", socket.gethostname().lower()).strip("-")[:24]
    return f"{host or 'ground'}-{secrets.token_hex(2)}"


class GroundGroup(Group):
    """This ground as a ``member`` of a group, with a ``page`` or none; a context manager.

    ``pass_s`` is how long an edge waits for its own member to claim it. For one thread, beside Zenoh's callbacks.
    """

    def __init__(
        self,
        session: zenoh.Session,
        name: str,
        *,
        member: str | None = None,
        page: str = "",
        clock: Callable[[], float] = time.monotonic,
        pass_s: float = _PASS_S,
    ) -> None:
        self.name, self.member = name, member or member_name()
        self._keys = GroupKeys(name)
        self._session = session
        self._clock = clock
        self._pass_s = pass_s
        self._began_s = clock()
        self._lock = threading.Lock()
        self._lines = TokenBucket(burst=_BURST, every_ns=_EVERY_NS)
        self._members: set[str] = {self.member}
        self._claims: defaultdict[str, set[str]] = defaultdict(set)
        """By edge, the other members that claim it."""
        self._mine: dict[str, bool] = {}
        """Whether each edge is this member's; until members or claims change."""
        self._unclaimed_s: dict[str, float] = {}
        """The time since which nobody has claimed an edge that is another member's."""
        self._passed: set[str] = set()
        """Edges that their member does not claim."""
        self._own: dict[str, tuple[float, zenoh.LivelinessToken]] = {}
        """The time since which each edge is claimed here."""
        self._serving: set[str] = set()
        self._pages: dict[str, str] = {}
        """The answers by member; empty for none."""
        self._requested: set[str] = set()
        """Members whose pages are queried."""
        key, data = self._keys.member(self.member), page.encode()
        self._answers = session.declare_queryable(key, lambda query: query.reply(key, data))
        self._token = session.liveliness().declare_token(self._keys.member(self.member))
        every = self._keys.everything
        self._watch = session.liveliness().declare_subscriber(every, self._on_token, history=True)

    @property
    def members(self) -> tuple[str, ...]:
        """All that are there, this one among them."""
        with self._lock:
            return tuple(sorted(self._members))

    @property
    def elsewhere(self) -> Mapping[str, Elsewhere]:
        with self._lock:
            found = {edge: min(members) for edge, members in sorted(self._claims.items()) if members}
            pages = dict(self._pages)
            unknown = set(found.values()) - pages.keys() - self._requested
            self._requested |= unknown
        for member in unknown:
            self._request_page(member)
        return {edge: Elsewhere(member, pages.get(member, "")) for edge, member in found.items()}

    def serves(self, edge: str) -> bool:
        now_s = self._clock()
        with self._lock:
            claimed_elsewhere = edge in self._claims
            if claimed_elsewhere or self._is_mine(edge):
                self._unclaimed_s.pop(edge, None)
            elif now_s - self._unclaimed_s.setdefault(edge, now_s) >= self._pass_s:
                self._passed.add(edge)
                del self._mine[edge]
            mine = self._is_mine(edge)
        if not mine or now_s - self._began_s < _JOIN_S:
            self._serving.discard(edge)
            return False
        if edge not in self._own:
            claim = self._session.liveliness().declare_token(self._keys.claim(self.member, edge))
            self._own[edge] = now_s, claim
        waited = not claimed_elsewhere and now_s - self._own[edge][0] >= _SETTLE_S
        if waited and edge not in self._serving:
            self._serving.add(edge)
            if edge in self._passed and self._lines.take(round(now_s * SECOND_NS)):
                said = "%s: %s does not claim %s (other --edges or keys?): it is served here"
                _log.warning(said, self.name, owner_of(edge, self.members), edge)
        # Once it is served, the claim of a member that is about to give way interrupts nothing.
        return edge in self._serving

    def release(self, edge: str) -> None:
        with self._lock:
            mine = self._is_mine(edge)
        if not mine:
            self._withdraw(edge)

    def forget(self, *, except_for: Iterable[str]) -> None:
        known = set(except_for)
        for edge in self._own.keys() - known:
            self._withdraw(edge)
        with self._lock:
            for edge in (self._mine.keys() | self._unclaimed_s.keys()) - known:
                self._mine.pop(edge, None)
                self._unclaimed_s.pop(edge, None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for declared in (self._watch, self._answers):
            declared.undeclare()  # type: ignore[no-untyped-call]
        for edge in list(self._own):
            self._withdraw(edge)
        self._token.undeclare()  # type: ignore[no-untyped-call]

    def _is_mine(self, edge: str) -> bool:
        # Under the lock. Who claims takes part, also where its own token has not come yet.
        if edge not in self._mine:
            others = {self.member} if edge in self._passed else self._members
            self._mine[edge] = owner_of(edge, others | self._claims.get(edge, set())) == self.member
        return self._mine[edge]

    def _request_page(self, member: str) -> None:
        # The answer comes in a callback; where none does it is asked again.

        def note(reply: zenoh.Reply) -> None:
            if reply.ok is None or len(reply.ok.payload) > _MOST_PAGE_BYTES:
                return
            page = reply.ok.payload.to_bytes().decode(errors="replace")
            with self._lock:
                if member in self._members and (not page or page.lower().startswith(("http://", "https://"))):
                    self._pages[member] = page

        def end() -> None:
            with self._lock:
                self._requested.discard(member)

        self._session.get(self._keys.member(member), zenoh.handlers.Callback(note, end), timeout=_ANSWER_S)

    def _withdraw(self, edge: str) -> None:
        self._serving.discard(edge)
        self._passed.discard(edge)
        claim = self._own.pop(edge, None)
        if claim is not None:
            claim[1].undeclare()  # type: ignore[no-untyped-call]

    def _on_token(self, sample: zenoh.Sample) -> None:
        parsed = self._keys.parse(str(sample.key_expr))
        if parsed is None or parsed[0] == self.member:
            return
        member, edge = parsed
        there = sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            self._mine.clear()
            known, most = self._members, _MOST_MEMBERS
            if edge is not None:
                known, most = self._claims[edge], _MOST_CLAIMS
            if not there:
                known.discard(member)
                if edge is None:
                    self._pages.pop(member, None)
            elif len(known) < most and len(self._claims) <= _MOST_EDGES:
                known.add(member)
            if edge is not None and not known:
                del self._claims[edge]
        if edge is None and self._lines.take(round(self._clock() * SECOND_NS)):
            level = logging.INFO if there else logging.WARNING
            _log.log(level, "%s: %s %s", self.name, member, "takes part" if there else "is gone")
