"""The side channel of an edge under its commands, frame by frame, with its real parts and a real budget."""

from collections import Counter

import cv2
import numpy as np

from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import ControlAnswer, ControlRequest, RoiHeader
from hvt_common.units import parse_bitrate
from hvt_common.values import Frame, View
from hvt_common.video.still_codecs import JpegCodec
from hvt_edge.config import EdgeConfig, check
from hvt_edge.control import Commands
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.operating import Keyframes
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.candidates import TrackMemory
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.on_demand import OnDemand
from hvt_edge.stills.outbox import Outbox
from hvt_edge.stills.policy.registry import method
from hvt_edge.stills.scheduler import Chooser, Suppression
from hvt_edge.stills.stage import StillSender
from media.base_coded import StandIn
from media.clips import START_NS
from rigs.flight import tracks_at
from rigs.world import Puts, make_operating, make_reconfiguration, make_transmitter

SOURCE, BASE = (960, 540), (640, 360)
VIEW = View.fitted(SOURCE, BASE, fit="letterbox")
FRAME_NS = 66_666_667
_NOISE = np.random.default_rng(3).integers(0, 255, (SOURCE[1] // 6, SOURCE[0] // 6, 3), np.uint8)
WORLD = cv2.resize(_NOISE, SOURCE, interpolation=cv2.INTER_CUBIC).astype(np.uint8)
SESSION = 77


def picture(index: int) -> np.ndarray:
    """The source frame of this index: no two are alike."""
    return np.ascontiguousarray(np.roll(WORLD, 4 * index, axis=1))


class Rig:
    """The side channel of an edge, frame by frame; a car drives from left to right."""

    def __init__(self, budget="400kbps", *, share=0.75, name="M1", codec="jpeg", ring_s=5.0) -> None:
        argv = {"source": "demo", "size": BASE, "budget": parse_bitrate(budget, name="b"), "method": name}
        self.config = check(EdgeConfig(**argv, video_share=share, preset="ultrafast"))
        self.out, self.outcomes, self.keyframes = Puts(), Counter(), Keyframes()
        self.budget = RollingBudget(BudgetSettings(self.config.budget_bps, self.config.base_bps, fps=15))
        self.ledger = Ledger()
        self.sender = make_transmitter(
            self.out, ledger=self.ledger, budget=self.budget, edge_id="edge-1", session_id=SESSION
        )
        maker = StillMaker(codec=StandIn(), fallback=JpegCodec()) if codec == "residual" else StillMaker()
        self.outbox = Outbox()
        self.maker = maker
        self.on_demand = OnDemand(
            FrameRing(max_bytes=100_000_000, max_age_ns=round(ring_s * 1e9)),
            outbox=self.outbox,
            maker=maker,
            view=VIEW,
            class_names=("car",),
            line=self.sender,
        )
        self.chooser = Chooser(
            method(name),
            suppression=Suppression.for_cooldown(0),
            memory=TrackMemory(),
            fps=15,
            most_bytes=self.sender.most_still_bytes(),
            on_outcome=lambda *outcome: self.outcomes.update([outcome]),
            on_demand=self.on_demand,
        )
        self.operating = make_operating(self.config)
        self.reconfiguration = make_reconfiguration(self.operating, self.config, BASE, self.sender)
        self.index, self.request_ns = -1, 0
        self.commands = Commands(
            self.config,
            operating=self.operating,
            session_id=SESSION,
            keyframes=self.keyframes,
            chooser=self.chooser,
            make_method=method,
            backlog=None,
            base_size=BASE,
            clock=lambda: self.request_ns,
            loop_clock=lambda: self.now_ns,
        )
        self.keyframes.done(START_NS)

    @property
    def now_ns(self) -> int:
        return START_NS + max(0, self.index) * FRAME_NS

    def box(self, index: int) -> tuple[float, float, float, float]:
        return 20.0 + 3 * index, 100.0, 80.0 + 3 * index, 140.0

    def run(self, frames: int, *, others: bool = False) -> None:
        """So many frames; with ``others`` the method's own stills are sent as well."""
        for _ in range(frames):
            self.index += 1
            pixels = picture(self.index)
            small = cv2.resize(pixels, BASE, interpolation=cv2.INTER_AREA)
            base = cv2.blur(small, (31, 31)).astype(np.uint8)
            tracks = tracks_at(self.index, {5: self.box(self.index)})
            shown = not self.budget.leaves_out(self.now_ns)
            seen = AnalyzedFrame(
                Frame(self.index, self.now_ns, pixels, base), base if shown else None, tracks, detected=others
            )
            if shown:
                size, now_ns = int(self.budget.base_step_bytes), self.now_ns
                self.budget.record_base(size, now_ns=self.budget.earliest_ns(size, now_ns=now_ns, base=True))
            self.chooser.on_demand.add(seen)
            self.chooser.consider(seen, now_ns=self.now_ns, allowance_bytes=1000)
            sender = StillSender(self.outbox, maker=self.maker, transmitter=self.sender)
            self.chooser.expire_requested(self.now_ns)
            for coded in self.chooser.requested(now_ns=self.now_ns):
                sender.put(coded, now_ns=self.now_ns, store=False)
            allowance = sender.allowance(self.now_ns, paced=True)
            for coded in self.chooser.stills(now_ns=self.now_ns, allowance=allowance):
                sender.put(coded, now_ns=self.now_ns, store=False)

    def ask(self, command: str, **arguments) -> ControlAnswer:
        """One request, a tenth of a second after the last, through the wire and back."""
        self.request_ns += 100_000_000
        request = ControlRequest(session_id=SESSION, command=command, arguments=arguments)
        answer = self.commands.answer(ControlRequest.parse(request.pack()))
        return ControlAnswer.parse(answer.pack())

    def asked(self) -> list[tuple[RoiHeader, bytes]]:
        return [(header, data) for header, data in self.out.stills if header.reason == "asked"]
