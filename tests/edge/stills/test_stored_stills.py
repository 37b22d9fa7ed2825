"""Stills in an outage: chosen as ever, coded without the base, kept instead of sent; and video that is asked for."""

from collections import Counter

import cv2
import numpy as np

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import Command, ControlRequest, RoiHeader, parse_backlog_still
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.values import Frame, View
from hvt_common.video.still_codecs import JpegCodec
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.config import EdgeConfig, check
from hvt_edge.control import Commands
from hvt_edge.perception.analyzer import Analyzer
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.policy.registry import method
from media.base_coded import StandIn
from programs.processes import eventually
from rigs.flight import CLASSES, RedSquares
from rigs.keeping import FRAMES, SIZE, Rig
from rigs.kept import opened
from rigs.world import make_still_stage

VIEW = View.fitted(SIZE, SIZE, fit="letterbox")
_NOISE = np.random.default_rng(0).normal(0, 12, (SIZE[1], SIZE[0]))
_TEXTURE = 6 * cv2.GaussianBlur(_NOISE, (0, 0), 1.5)[..., None]


class StillRig(Rig):
    """Base stage and still stage, one after the other for each frame; stills build on the base where they can."""

    def __init__(self, folder) -> None:
        maker = StillMaker(codec=StandIn(), fallback=JpegCodec())
        super().__init__(folder, maker=maker)
        self.chosen: Counter[tuple[str, str]] = Counter()
        tracker = ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="off"), fps=15)
        self.side = make_still_stage(
            self.sender,
            Analyzer(RedSquares(), tracker, view=VIEW, detect_every=5),
            keyframes=self.keyframes,
            outcomes=self.chosen,
            view=VIEW,
            class_names=CLASSES,
            maker=maker,
            outbox=self.outbox,
            backlog=self.backlog,
        )

    def fly(self, first: int, end: int, *, linked: bool = True) -> None:
        self.linked = linked
        for frame in FRAMES[first:end]:
            self.now_ns = frame.capture_ns
            self.link_control.before_frame(self.now_ns)
            unit = self.base(frame)
            source = np.clip(frame.base_bgr + _TEXTURE, 0, 255).astype(np.uint8)
            seen = self.side.analyze(Frame(frame.index, frame.capture_ns, source, frame.base_bgr), unit)
            self.side.step(seen, now_ns=self.now_ns)

    @property
    def live(self) -> list[RoiHeader]:
        return [RoiHeader.parse(extra, data) for row, data, extra in self.out.puts if row is Channel.ROI]

    def stored(self) -> list[RoiHeader]:
        self.close()
        with opened(self.path, session_id=8) as folder:
            stills = [parse_backlog_still(folder.read(entry)) for entry in folder.best_stills()]
        return sorted(
            (RoiHeader.parse(one.attachment, one.payload) for one in stills), key=lambda one: one.sequence
        )


def test_stills_of_an_outage_are_kept_without_holes_and_without_the_base(tmp_path):
    """The ground could not show them, because the base comes later; or would ask for numbers that never come."""
    rig = StillRig(tmp_path / "store")
    rig.fly(0, 20)
    before = [one.sequence for one in rig.live]
    assert before == list(range(len(before)))
    assert {one.codec for one in rig.live} == {StandIn().name}
    rig.fly(20, 50, linked=False)
    assert [one.sequence for one in rig.live] == before, "nothing goes into the dark"
    rig.fly(50, 70)
    after = [one.sequence for one in rig.live]
    assert len(after) > len(before)
    assert after == list(range(len(after))), "no hole for what was kept"
    stored = rig.stored()
    assert {one.codec for one in stored} == {"jpeg"}
    kept = [one for one in stored if one.sequence >= 2**31]
    assert [one.sequence - 2**31 for one in kept] == list(range(len(kept)))
    assert len(kept) >= 2
    assert {one.frame_index for one in kept} <= set(range(20, 50))
    assert rig.chosen["deferred", "stored"] == len(kept)
    assert rig.chosen["sent", "stored"] == 0


def test_stills_that_the_link_lost_are_stored_without_the_base(tmp_path):
    """Those sent in the second before the break would be lost, or come back as nothing that can be shown."""
    rig = StillRig(tmp_path / "store")
    rig.fly(0, 20)
    sent = {one.sequence: one.frame_index for one in rig.live}
    rig.fly(20, 22, linked=False)
    lost = [one for one in rig.stored() if one.sequence < 2**31]
    assert {one.sequence: one.frame_index for one in lost} == sent
    assert {one.codec for one in lost} == {"jpeg"}


def test_whoever_commands_gets_the_video_before_the_stills(tmp_path):
    """The command would be refused, or change nothing."""
    rig = StillRig(tmp_path / "store")
    config = check(EdgeConfig(source="demo", size=SIZE))

    def ask(backlog: BacklogStage | None) -> str:
        commands = Commands(
            config,
            operating=rig.operating,
            session_id=7,
            keyframes=rig.keyframes,
            chooser=None,
            make_method=method,
            backlog=backlog,
            base_size=SIZE,
            clock=lambda: rig.now_ns,
            loop_clock=lambda: rig.now_ns,
        )
        rig.now_ns += 100_000_000
        request = ControlRequest(session_id=7, command=Command.SEND_BACKLOG, arguments={})
        answer = commands.answer(ControlRequest.parse(request.pack()))
        return "" if answer.accepted else answer.reason

    assert "nothing is stored" in ask(rig.backlog)
    rig.fly(0, 7)
    rig.report()
    rig.fly(7, 50, linked=False)
    eventually(lambda: rig.backlog.worker.numbers.stills >= 2, what="stills are kept")
    assert ask(rig.backlog) == ""
    rig.linked = True
    rig.finish()
    assert rig.backlog.worker.numbers.empty
    kinds = [header.kind for header, _ in rig.out.backlog]
    assert kinds.index("still") > max(n for n, kind in enumerate(kinds) if kind == "base")
    rig.backlog.close()
    assert "--store 0" in ask(None)
