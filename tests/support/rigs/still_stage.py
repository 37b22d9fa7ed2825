"""The still stage of an edge from its real parts, around a transmitter that a test has made."""

from __future__ import annotations

from collections import Counter

from hvt_common.values import View
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.keyframes import Keyframes
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.perception.analyzer import Analyzer
from hvt_edge.perception.candidates import TrackMemory
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.on_demand import OnDemand
from hvt_edge.stills.outbox import Outbox
from hvt_edge.stills.policy.registry import method
from hvt_edge.stills.scheduler import Chooser, ChooserSettings
from hvt_edge.stills.stage import StillSender, StillStage
from hvt_edge.stills.suppression import Suppression


def make_still_stage(
    transmitter: Transmitter,
    analyzer: Analyzer,
    *,
    keyframes: Keyframes,
    outcomes: Counter[tuple[str, str]],
    view: View,
    class_names: tuple[str, ...],
    maker: StillMaker | None = None,
    memory: TrackMemory | None = None,
    outbox: Outbox | None = None,
    reporter=None,
    backlog: BacklogStage | None = None,
    ring: FrameRing | None = None,
) -> StillStage:
    """Of method M1, without suppression; ``outcomes`` counts what becomes of candidates.

    Grounds may request stills of what ``ring`` holds.
    """
    outbox, maker = Outbox() if outbox is None else outbox, maker or StillMaker()
    on_demand = None
    if ring is not None:
        on_demand = OnDemand(
            ring, outbox=outbox, maker=maker, view=view, class_names=class_names, line=transmitter
        )
    chooser = Chooser(
        method("M1"),
        outbox=outbox,
        suppression=Suppression.for_cooldown(0),
        maker=maker,
        memory=TrackMemory() if memory is None else memory,
        view=view,
        class_names=class_names,
        settings=ChooserSettings(fps=15, most_bytes=10_000),
        on_outcome=lambda *outcome: outcomes.update([outcome]),
        on_demand=on_demand,
    )
    return StillStage(
        analyzer,
        chooser,
        outbox=outbox,
        sender=StillSender(outbox, maker=maker, transmitter=transmitter, backlog=backlog),
        transmitter=transmitter,
        keyframes=keyframes,
        reporter=reporter,
    )
