"""A still with its header packed once, from the first weighing to the last copy that is sent or stored."""

from __future__ import annotations

from dataclasses import dataclass

from hvt_common.protocol.messages import AlsoShown, PackedMessage, RoiHeader, fitted_text
from hvt_common.values import Still

_PLAIN_ENCODING = "application/octet-stream"
"""The encoding of formats that only HVT reads; one byte on the wire."""
_OWN_TYPES = "application/vnd.hvt."


@dataclass(frozen=True, slots=True)
class StillEnvelope:
    """Send delay, flags and checksum are packed when it goes out."""

    still: Still
    header: PackedMessage
    encoding: str
    """What Zenoh is told of the payload: its media type, if there is any program beside HVT that could read it.

    Spelling a type of our own out would cost up to 34 bytes a still, and the header names the codec anyway.
    """

    @classmethod
    def of(cls, still: Still, *, session_id: int) -> StillEnvelope:
        """Pack the header."""
        header = RoiHeader(
            session_id=session_id,
            sequence=still.sequence,
            frame_index=still.frame_index,
            capture_ns=still.capture_ns,
            send_delay_ns=0,
            flags=0,
            track_id=still.track_id,
            box_source_px=still.box_source_px,
            crop_source_px=still.crop_source_px,
            class_name=fitted_text(still.class_name, 64),
            confidence=still.confidence,
            reason=fitted_text(still.reason, 48),
            codec=still.codec,
            quality_pct=still.quality_pct,
            parameters=still.parameters,
            also=tuple(AlsoShown(track_id=one, box_source_px=box) for one, box in still.also),
        )
        own = still.media_type.startswith(_OWN_TYPES)
        return cls(still, PackedMessage.of(header), _PLAIN_ENCODING if own else still.media_type)

    def header_at(self, send_ns: int, *, flags: int, frame_sent: bool = False) -> PackedMessage:
        """The header of a still that goes out at this time; ``frame_sent``: who gets it can have the capture time."""
        times = {"send_delay_ns": send_ns - self.still.capture_ns}
        if frame_sent and "ask" not in self.still.parameters:  # who asks need not have the video
            times["capture_ns"] = -1
        return self.header.with_fields(flags=int(flags), **times)
