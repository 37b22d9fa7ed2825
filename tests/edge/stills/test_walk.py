"""How far a still walks through the code: who follows one by reading must not get lost."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings
from hvt_common.values import View
from hvt_common.video.still_codecs import JpegCodec
from hvt_edge.keyframes import Keyframes
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.perception.analyzer import Analyzer
from hvt_edge.stills.maker import StillMaker
from hvt_edge.video.encoder_settings import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from media.base_coded import StandIn
from media.clips import framed, smooth_pictures
from rigs.flight import CLASSES, SIZE, RedSquares
from rigs.still_stage import make_still_stage

MOST_FILES = 17


class Out:
    """Notes what was put."""

    def __init__(self) -> None:
        self.rows: list[Channel] = []

    def put(self, row, _payload, *, attachment=None, encoding="") -> None:
        """Note it."""
        self.rows.append(row)


def test_from_the_analyzed_frame_to_the_link_a_still_enters_few_files():
    """A newcomer would open thirty files to find out where a still is decided, made and sent."""
    (frame,) = framed(smooth_pictures(1, size=SIZE))
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 12, (SIZE[1], SIZE[0])), (0, 0), 1.5)
    source = np.clip(frame.base_bgr + 6 * noise[..., None], 0, 255).astype(np.uint8)
    frame = replace(frame, source_bgr=source)  # detail that the base does not show
    unit = BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=120_000, preset="ultrafast")).encode(
        frame
    )
    out, keyframes, view = Out(), Keyframes(), View.fitted(SIZE, SIZE, fit="letterbox")
    transmitter = Transmitter(
        out,
        ledger=Ledger(),
        budget=RollingBudget(BudgetSettings(400_000, 200_000, fps=15)),
        edge_id="edge-1",
        session_id=1,
        lockstep=False,
        wait_until=lambda _at: None,
    )
    tracker = ByteTracker(TrackerSettings.starting_at(0.25, camera_motion="off"), fps=15)
    stage = make_still_stage(
        transmitter,
        Analyzer(RedSquares(), tracker, view=view),
        keyframes=keyframes,
        outcomes=Counter(),
        view=view,
        class_names=CLASSES,
        maker=StillMaker(codec=StandIn(), fallback=JpegCodec()),
    )
    keyframes.done(frame.capture_ns)
    analyzed = stage.analyze(frame, unit)
    entered: set[str] = set()

    def note(code_frame, event, _argument) -> None:
        file = code_frame.f_code.co_filename
        if event == "call" and "/hvt_edge/" in file:
            entered.add(file.split("/hvt_edge/")[1])

    sys.setprofile(note)
    try:
        stage.send(analyzed, now_ns=frame.capture_ns)
    finally:
        sys.setprofile(None)
    assert out.rows == [Channel.ROI], "a still went out"
    assert len(entered) <= MOST_FILES, sorted(entered)
