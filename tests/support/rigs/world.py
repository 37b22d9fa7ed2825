"""Real parts of an edge, put together as in flight; a test says only what it is about."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import BaseHeader, RoiHeader
from hvt_common.runtime.failures import Failures
from hvt_common.values import AccessUnit, Frame, View
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.config import EdgeConfig
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.feedback import Detected
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating import Keyframes, Operating
from hvt_edge.perception.analyzer import Analyzer
from hvt_edge.perception.candidates import TrackMemory
from hvt_edge.perception.cpu_budget import CpuBudget
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.source.contract import Source
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.on_demand import OnDemand
from hvt_edge.stills.outbox import Outbox
from hvt_edge.stills.policy.registry import method
from hvt_edge.stills.scheduler import Chooser, Suppression
from hvt_edge.stills.stage import StillSender, StillStage
from hvt_edge.video.reconfigure import EncoderReconfiguration
from hvt_edge.video.stage import BaseStage
from hvt_edge.wiring.video import make_encoder
from hvt_edge.wiring.video import make_reconfiguration as reconfiguration_of


class Puts:
    """A link that keeps what was put, in order."""

    def __init__(self) -> None:
        self.puts: list[tuple[Channel, bytes, bytes, str]] = []

    def put(
        self, row: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        self.puts.append((row, payload, attachment or b"", encoding))

    @property
    def base(self) -> list[BaseHeader]:
        return [BaseHeader.parse(extra, data) for row, data, extra, _ in self.puts if row is Channel.BASE]

    @property
    def units(self) -> list[bytes]:
        return [data for row, data, _, _ in self.puts if row is Channel.BASE]

    @property
    def stills(self) -> list[tuple[RoiHeader, bytes]]:
        return [
            (RoiHeader.parse(extra, data), data) for row, data, extra, _ in self.puts if row is Channel.ROI
        ]


class QuietStills:
    """Perception and stills of a frame loop, which find and send nothing."""

    def __init__(self) -> None:
        self.latest_tracks, self.outbox = None, Outbox()
        self.analyzer = SimpleNamespace(cpu_budget=CpuBudget())
        self.seen: list[tuple[int, int | None]] = []
        """(frame, unit) of all that was analyzed, by their indices."""
        self.steps = 0
        self.detected: list[tuple[int, Detected]] = []
        """(steps by then, what the ground has said)."""

    def capture(self, frame: Frame) -> None:
        """Nobody requests a still of it."""

    def is_used(self, _capture_ns: int) -> bool:
        return True

    def analyze(self, frame: Frame, unit: AccessUnit | None, _skipped: Sequence[AccessUnit] = ()) -> int:
        self.seen.append((frame.index, None if unit is None else unit.frame_index))
        return frame.index

    def send_requested(self, **_moment: Any) -> set[int]:
        return set()

    def step(self, _seen: int, **_moment: Any) -> set[int]:
        self.steps += 1
        return set()

    def on_results(self, _results: object, *, detected: Detected | None = None) -> None:
        if detected is not None:
            self.detected.append((self.steps, detected))


def make_transmitter(
    out: Any, *, budget: RollingBudget | tuple[int, int] = (800_000, 400_000), **parts: Any
) -> Transmitter:
    """That puts into ``out``; ``budget`` is one, or its total and the video's share, bits a second."""
    if isinstance(budget, tuple):
        budget = RollingBudget(BudgetSettings(*budget, fps=15))
    plain: dict[str, Any] = {
        "ledger": Ledger(),
        "edge_id": "uav-1",
        "session_id": 1,
        "lockstep": False,
        "wait_until": lambda _at_ns: None,
    }
    return Transmitter(out, budget=budget, **(plain | parts))


def make_base_stage(encoder: Any, transmitter: Transmitter, **parts: Any) -> BaseStage:
    """Of this encoder, without a copy and without a store."""
    plain: dict[str, Any] = {"keyframes": Keyframes(), "local_copy": None, "first_keyframe_bytes": 5000}
    plain["failures"] = Failures(time.time_ns)
    return BaseStage(encoder, transmitter=transmitter, **(plain | parts))


def make_operating(config: EdgeConfig, *, decimation: int = 1) -> Operating:
    return Operating(
        budget_bps=config.budget_bps,
        video_share=config.fixed_share,
        base_bps=config.base_bps,
        method=config.method,
        decimation=decimation,
    )


def make_reconfiguration(
    operating: Operating, config: EdgeConfig, size: tuple[int, int], transmitter: Transmitter, **parts: Any
) -> EncoderReconfiguration:
    plain = {"open_encoder": partial(make_encoder, config, size=size), "split": None, "pacer": None}
    return reconfiguration_of(config, operating, size, budget=transmitter.budget, **(plain | parts))


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
    ring = FrameRing(max_bytes=0) if ring is None else ring
    on_demand = OnDemand(
        ring, outbox=outbox, maker=maker, view=view, class_names=class_names, line=transmitter
    )
    chooser = Chooser(
        method("M1"),
        suppression=Suppression.for_cooldown(0),
        memory=TrackMemory() if memory is None else memory,
        fps=15,
        most_bytes=10_000,
        on_outcome=lambda *outcome: outcomes.update([outcome]),
        on_demand=on_demand,
    )
    return StillStage(
        analyzer,
        chooser,
        sender=StillSender(outbox, maker=maker, transmitter=transmitter, backlog=backlog),
        keyframes=keyframes,
        reporter=reporter,
    )


class PassedOn(Source):
    """Another source; ``before`` is called before each frame, and ends it where it says True."""

    live = False

    def __init__(self, inner: Source, *, before: Callable[[Frame], bool | None]) -> None:
        self._inner, self._before = inner, before
        self.view, self.fps, self.frame_count = inner.view, inner.fps, inner.frame_count

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        for frame in self._inner.frames(start_ns=start_ns):
            if self._before(frame):
                return
            yield frame

    def close(self) -> None:
        self._inner.close()
