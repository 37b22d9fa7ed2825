"""A base stream that can be decoded from its first unit on, and after every gap."""

from __future__ import annotations

from hvt_common.video.hevc import parameter_sets
from hvt_ground.events import VideoSample


class DecodableRun:
    """Begins at a keyframe; each keyframe has its parameter sets, which a reader that joins there needs."""

    def __init__(self) -> None:
        self._sets = b""
        """The newest parameter sets."""
        self._awaits_keyframe = True

    def interrupt(self) -> None:
        """Units are missing: it goes on at the next keyframe."""
        self._awaits_keyframe = True

    def decodable(self, sample: VideoSample) -> bytes:
        """The unit, Annex B; empty where nobody could decode it."""
        if sample.keyframe:
            sets = parameter_sets(sample.data)
            self._sets = sets or self._sets
            self._awaits_keyframe = not self._sets
            if sets:
                return sample.data
            return self._sets + sample.data if self._sets else b""
        return b"" if self._awaits_keyframe else sample.data
