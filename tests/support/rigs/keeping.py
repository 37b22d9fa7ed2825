"""The frame loop's stages of an edge with a store, and a link that goes and comes, with a ground at its other end."""

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import (
    BacklogHeader,
    BacklogKind,
    BaseHeader,
    Feedback,
    RoiHeader,
    parse_backlog_still,
    parse_backlog_units,
)
from hvt_common.runtime.failures import Failures
from hvt_common.values import AccessUnit, Frame
from hvt_edge.backlog.disk import Store
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.config import EdgeConfig, check
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import RateController
from hvt_edge.loop.realtime import LinkControl
from hvt_edge.operating import Keyframes, KeyframeSettings
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.outbox import Outbox, OutboxStill
from hvt_edge.stills.stage import StillSender
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from hvt_ground.backlog.assembly import BacklogAssembly
from media.clips import START_NS, framed, hard_pictures
from programs.processes import eventually
from rigs.kept import INFO, S, opened
from rigs.messages import feedback, still_of
from rigs.world import make_base_stage, make_operating, make_reconfiguration, make_transmitter

SIZE = (320, 192)
FRAMES = framed(hard_pictures(210, size=SIZE))
STILL = still_of(b"\xff" * 1500, sequence=2**31, frame_index=3, capture_ns=START_NS, track_id=1)
PENDING = replace(STILL, crop_bgr=np.zeros((4, 4, 3), np.uint8), data=b"")


class Ground:
    """What arrives, and what it says of that."""

    def __init__(self) -> None:
        self.base_sequence = self.still_sequence = self.number = -1
        self.stills: set[int] = set()
        self.frames: set[int] = set()
        self.twice: Counter[tuple[int, str, int]] = Counter()
        """Objects of what was kept, as often as they came."""
        self.backlog_frames: dict[int, bytes] = {}
        self.backlog_stills: set[int] = set()
        self.assembly = BacklogAssembly()

    def take(self, row: Channel, payload: bytes, attachment: bytes) -> None:
        if row is Channel.BASE:
            base = BaseHeader.parse(attachment, payload)
            self.base_sequence = max(self.base_sequence, base.sequence)
            self.frames.add(base.frame_index)
        elif row is Channel.ROI:
            still = RoiHeader.parse(attachment, payload)
            self.still_sequence = max(self.still_sequence, still.sequence)
            self.stills.add(still.sequence)
        elif row is Channel.BACKLOG:
            header = BacklogHeader.parse(attachment, payload)
            whole = self.assembly.chunk(header, payload)
            if whole is not None:
                self._content((header.session_id, header.kind, header.number), whole)

    def _content(self, key: tuple[int, str, int], whole: bytes) -> None:
        self.twice[key] += 1
        self.assembly.settle(key, usable=True)
        if key[1] == BacklogKind.BASE:
            self.backlog_frames |= {unit.frame_index: unit.data for unit in parse_backlog_units(whole)}
        elif key[1] == BacklogKind.STILL:
            still = parse_backlog_still(whole)
            self.backlog_stills.add(RoiHeader.parse(still.attachment, still.payload).sequence)

    def report(self, now_ns: int) -> Feedback:
        self.number += 1
        missing = [one for one in range(self.still_sequence) if one not in self.stills]
        return feedback(
            sequence=self.number,
            send_ns=now_ns,
            base_messages=len(self.frames),
            roi_messages=len(self.stills),
            base_sequence=self.base_sequence,
            still_sequence=self.still_sequence,
            missing_stills=tuple(missing[-16:]),
            backlog=self.assembly.take_acknowledged_ranges(16),
        )


class Out:
    """The link: what was put, and, unless it is dark, a ground that hears it."""

    def __init__(self) -> None:
        self.puts: list[tuple[Channel, bytes, bytes]] = []
        self.ground = Ground()
        self.dark = False
        self.before_put: Callable[[Channel], None] = lambda _row: None

    def put(self, row, payload, *, attachment=None, encoding="") -> None:
        self.before_put(row)
        self.puts.append((row, payload, attachment or b""))
        if not self.dark:
            self.ground.take(row, payload, attachment or b"")

    @property
    def base(self) -> list[BaseHeader]:
        return [BaseHeader.parse(extra, data) for row, data, extra in list(self.puts) if row is Channel.BASE]

    @property
    def backlog(self) -> list[tuple[BacklogHeader, bytes]]:
        return [
            (BacklogHeader.parse(extra, data), data)
            for row, data, extra in list(self.puts)
            if row is Channel.BACKLOG
        ]


class Rig:
    """The frame loop's stages with a store. The clock stands still but for frames, and for `finish`."""

    def __init__(
        self,
        folder: Path,
        *,
        live: bool = False,
        adapt: bool = False,
        borrow_unused: bool = False,
        info: Callable[[], bytes] = INFO.pack,
        session_id: int = 7,
        budget: tuple[int, int] = (800_000, 400_000),
        maker: StillMaker | None = None,
        inbox: FeedbackInbox | None = None,
    ) -> None:
        self.path, self.out, self.now_ns = folder, Out(), START_NS
        self.looked_ns = START_NS
        """When the store's thread looked at the clock."""
        self.linked = True
        self.keyframes = Keyframes(KeyframeSettings(interval_ns=60 * S))
        self.outbox, self.ledger = Outbox(), Ledger()
        pacer = Pacer(RateController(ceiling_bps=800_000, floor_bps=100_000)) if adapt else None
        self.pacer = pacer
        self.sender = make_transmitter(
            self.out,
            ledger=self.ledger,
            budget=RollingBudget(BudgetSettings(*budget, fps=15, borrow_unused=borrow_unused)),
            session_id=session_id,
            pacer=pacer,
        )
        self.failures = Failures(lambda: self.now_ns)
        self.backlog = BacklogStage(
            Store(
                folder,
                max_bytes=50_000_000,
                session_id=session_id,
                info=info,
                clock=lambda: self.now_ns,
                since_boot=lambda: ("a boot", self.now_ns - START_NS),
            ),
            self.sender,
            live=live,
            has_subscriber=lambda: True,
            stills_pending=lambda: self.outbox.any_pending,
            stills_in_flight=lambda: self.outbox.unacknowledged,
            keyframes=self.keyframes,
            clock=self._clock,
            failures=self.failures,
        )
        config = check(EdgeConfig(source="demo", size=SIZE, budget=budget[0], preset="ultrafast"))
        self.stills = StillSender(
            self.outbox, maker=maker or StillMaker(), transmitter=self.sender, backlog=self.backlog
        )
        self.operating = make_operating(config)
        self.watched = False
        """Somebody subscribes to the video who is no ground."""
        self.link_control = LinkControl(
            has_ground=self._has_ground,
            has_subscriber=lambda: self.watched,
            failures=self.failures,
            keyframes=self.keyframes,
            inbox=inbox or FeedbackInbox(),
            reconfiguration=make_reconfiguration(self.operating, config, SIZE, self.sender, pacer=pacer),
            clock=lambda: self.now_ns,
            stills=self.stills,
        )
        self.before_link: Callable[[], None] = lambda: None
        """Called before the edge is told whether anybody is there."""
        self.asked: list[int] = []
        """When the link was asked for room for a frame."""
        self.admits: Callable[[int, int, int], bool] = self.link_control.admits
        self.stage = make_base_stage(
            BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=200_000, preset="ultrafast")),
            self.sender,
            keyframes=self.keyframes,
            admits=self._asked_to_admit,
            backlog=self.backlog,
        )
        self.coded: dict[int, bytes] = {}

    def _clock(self) -> int:
        if threading.current_thread().name == "hvt-store":
            self.looked_ns = self.now_ns
        return self.now_ns

    def play(self, first: int, end: int, *, linked: bool = True, reports: bool = False) -> None:
        """Frames of that stretch; a ground that ``reports`` does so after each seventh."""
        self.linked = linked
        for frame in FRAMES[first:end]:
            self.now_ns = frame.capture_ns
            self.link_control.before_frame(self.now_ns)
            unit = self.base(frame)
            if unit is not None:
                self.coded[frame.index] = unit.data
            if reports and frame.index % 7 == 6:
                self.report()

    def base(self, frame: Frame) -> AccessUnit | None:
        decision = self.stage.decide(frame, now_ns=self.now_ns)
        unit = self.stage.encode(frame, decision, now_ns=self.now_ns)
        if unit is not None:
            self.stage.send(unit, decision, now_ns=self.now_ns)
        return unit

    def _has_ground(self) -> bool:
        self.before_link()
        return self.linked

    def _asked_to_admit(self, now_ns: int, line_bytes: int, coding_ns: int) -> bool:
        self.asked.append(now_ns)
        return self.admits(now_ns, line_bytes, coding_ns)

    def report(self) -> None:
        """The ground says what it has, unless nobody hears it."""
        if not self.out.dark:
            self.link_control.on_feedback(self.out.ground.report(self.now_ns))

    def still(self, sequence: int, *, utility: float = 1.0) -> None:
        one = _pending(utility, self.now_ns)
        self.outbox.sent(one, STILL.with_header(sequence=sequence), now_ns=self.now_ns)
        self.stills.put(one, now_ns=self.now_ns, store=False)

    def store(self, *, utility: float = 1.0) -> None:
        """One is coded while the link is away, or as if it were."""
        one = _pending(utility, self.now_ns)
        self.outbox.stored(one, STILL)
        self.stills.put(one, now_ns=self.now_ns, store=True)

    def close(self) -> None:
        self.stills.close(self.now_ns)
        self.backlog.close()

    def finish(self, *, reports: bool = True) -> list[str]:
        """After the last frame, in a tenth of a second a turn; what the user is told."""
        notes: list[str] = []
        turns = 0

        def turn() -> None:
            nonlocal turns
            turns += 1
            time.sleep(0.005)
            # The clock would run away from the thread that reads what was kept.
            eventually(lambda: self.now_ns - self.looked_ns < S)
            self.now_ns += S // 10
            if reports and turns % 4 == 0:
                self.report()

        self.before_link = turn
        self.link_control.finish(stop=threading.Event(), note=notes.append)
        return notes

    def kept(self) -> list:
        self.close()
        now_s = (self.now_ns - START_NS) / S
        with opened(self.path, session_id=8, at_s=(now_s, now_s)) as folder:
            return [
                unit
                for entry in reversed(list(folder.newest_segments()))
                for unit in parse_backlog_units(folder.read(entry))
            ]

    def stored_stills(self) -> dict[int, float]:
        """Numbers and worth of the stills that another start of the edge finds."""
        self.close()
        now_s = (self.now_ns - START_NS) / S
        with opened(self.path, session_id=8, at_s=(now_s, now_s)) as folder:
            return {entry.number: entry.rank for entry in folder.best_stills()}


def _pending(utility: float, now_ns: int) -> OutboxStill:
    return OutboxStill(PENDING, None, utility, now_ns)
