"""Sends a coded still to the link, or to the backlog while the link is down."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from hvt_common.values import Still
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.stills.crop_job import CropJob
from hvt_edge.stills.maker import Allowance, NoStill, StillMaker
from hvt_edge.stills.outbox import AGAIN, Outbox, OutboxStill


@dataclass(eq=False)
class StillSender:
    """`put` is for both threads of stills, the rest for that of the method's, or who ends the run after its end.

    ``backlog`` may be None.
    """

    outbox: Outbox
    _: KW_ONLY
    maker: StillMaker
    transmitter: Transmitter
    backlog: BacklogStage | None = None

    def __post_init__(self) -> None:
        self._breaks = 0
        """Breaks of the link that were noticed here."""

    @property
    def offline(self) -> bool:
        """Whether the link is away, and stills are stored."""
        return self.backlog is not None and self.backlog.offline

    def allowance(self, now_ns: int, *, paced: bool) -> Allowance:
        """Payload bytes that a still may take now."""
        return lambda still: self.transmitter.still_allowance_bytes(now_ns, still=still, paced=paced)

    def put(self, coded: OutboxStill, *, now_ns: int, store: bool) -> None:
        """Send a coded still, or a second copy of it, or store it."""
        if store:
            self._store(coded, now_ns=now_ns, counted=True)
            return
        coded.envelope = coded.envelope or self.transmitter.envelope(coded.still)
        # A second copy waits for its allowance like any other: nobody waits for it.
        copy, requested = AGAIN if coded.copies > 1 else "", coded.request is None and coded.copies == 1
        self.transmitter.still(coded.envelope, now_ns=now_ns, copy=copy, requested=requested)

    def store_lost(self, now_ns: int) -> None:
        """Store stills that were sent before the link went, or came back, and that no report has named."""
        if self.backlog is None or self.backlog.breaks == self._breaks:
            return
        self._breaks = self.backlog.breaks
        for lost in self.outbox.lose():
            self.outbox.stored(lost, self._without_base(lost.still, lost.job))
            self._store(lost, now_ns=now_ns, counted=False)

    def close(self, now_ns: int) -> None:
        """The run ends: stills that no report has named are stored."""
        if self.backlog is not None:
            self.backlog.end_in_flight()
        self.store_lost(now_ns)

    def _store(self, one: OutboxStill, *, now_ns: int, counted: bool) -> None:
        assert self.backlog is not None, "nothing is stored without one"
        if one.envelope is None or one.envelope.still is not one.still:
            one.envelope = self.transmitter.envelope(one.still)
        packed = self.transmitter.store_still(one.envelope, now_ns=now_ns, counted=counted)
        self.backlog.store_still(
            packed, number=one.still.sequence, capture_ns=one.still.capture_ns, utility=one.utility
        )

    def _without_base(self, still: Still, job: CropJob | None) -> Still:
        # A sent still, coded anew without the base; itself where it is so, or its crop is gone.
        if job is None:
            return still
        most_bytes = self.transmitter.most_still_bytes()
        made = self.maker.code(job, sequence=still.sequence, allowance=lambda _: most_bytes)
        return still if isinstance(made, NoStill) else made
