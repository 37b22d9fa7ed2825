"""One frame of the base stream: decide on a keyframe, encode, keep, send."""

from __future__ import annotations

from hvt_common.values import AccessUnit, Frame
from hvt_edge.encode import BaseEncoder
from hvt_edge.keyframes import KeyframePlan
from hvt_edge.record_base import BaseRecorder
from hvt_edge.send import Sender

__all__ = ["BaseStage"]


class BaseStage:
    """Runs in the frame loop. ``first_keyframe_bytes`` is the guess until a keyframe has been seen."""

    def __init__(
        self,
        encoder: BaseEncoder,
        *,
        keyframes: KeyframePlan,
        sender: Sender,
        recorder: BaseRecorder | None,
        first_keyframe_bytes: int,
    ) -> None:
        self._encoder = encoder
        self._keyframes = keyframes
        self._sender = sender
        self._recorder = recorder
        self._keyframe_bytes = first_keyframe_bytes

    def encode(self, frame: Frame, *, now_ns: int) -> AccessUnit:
        """Encode the frame, as a keyframe where one is due and fits."""
        fits = self._sender.keyframe_fits(self._keyframe_bytes, now_ns=now_ns)
        unit = self._encoder.encode(frame, keyframe=self._keyframes.now(now_ns, fits=fits))
        if unit.keyframe:
            self._keyframes.done(now_ns)
        if self._recorder is not None:
            self._recorder.write(unit)
        return unit

    def send(self, unit: AccessUnit, *, now_ns: int) -> None:
        """Send the unit; blocks while the link is full, and frames are then dropped before they are encoded."""
        line_bytes = self._sender.base(unit, now_ns=now_ns)
        if unit.keyframe:
            self._keyframe_bytes = line_bytes
