"""What changes with a keyframe: the frame rate, and the base's share. x265 is opened anew for either."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from hvt_edge.build import make_encoder
from hvt_edge.candidates import Candidate
from hvt_edge.config import EdgeConfig
from hvt_edge.encode import BaseEncoder
from hvt_edge.methods.base import Step
from hvt_edge.send import Sender
from hvt_edge.split import Split

__all__ = ["Renewal"]


class Renewal:
    """Called before each keyframe; watches decision steps, which may come from another thread."""

    def __init__(
        self,
        config: EdgeConfig,
        *,
        size: tuple[int, int],
        every_n: int,
        sender: Sender,
        split: Split | None,
    ) -> None:
        self._config = config
        self._size = size
        self._every_n = every_n
        self._base_bps = config.base_bps
        self._sender = sender
        self._split = split
        self.on_change: Callable[[], None] = lambda: None
        """Called when the budget has been told of a new split."""
        self._lock = threading.Lock()
        self.count = 0
        """How often x265 was opened anew."""

    @property
    def base_bps(self) -> int:
        """B_v as it is now."""
        return self._base_bps

    def observe(self, candidates: Sequence[Candidate], step: Step) -> None:
        """Take in all tracks of a decision step."""
        if self._split is not None:
            with self._lock:
                self._split.observe(candidates, step)

    def __call__(self, every_n: int, now_ns: int) -> BaseEncoder | None:
        """Return the encoder to go on with from this keyframe, or None for the one there is."""
        base_bps = self._proposed_bps()
        if (every_n, base_bps) == (self._every_n, self._base_bps):
            return None
        self._every_n, self._base_bps = every_n, base_bps
        self.count += 1
        self._sender.set_base(base_bps, self._config.tick_fps / every_n, now_ns=now_ns)
        self.on_change()
        return make_encoder(self._config, size=self._size, every_n=every_n, base_bps=base_bps)

    def _proposed_bps(self) -> int:
        if self._split is None:
            return self._base_bps
        with self._lock:
            share = self._split.propose()
        return self._base_bps if share is None else round(self._config.budget_bps * share)
