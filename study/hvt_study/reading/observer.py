"""Stands beside a flight's ground with a reader, and has it read arriving base pictures, stills and the composite.

Of the truth the reader gets one thing: the box around a code at the frame that a picture shows. It does not learn
which way the code is turned, how many characters it has, or which ones may occur.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from hvt_common.values import Image, View
from hvt_common.video.still_codecs import BaseMissingError, StillError
from hvt_ground.perception.history import as_bgr
from hvt_ground.perception.pipeline import DecodedFrame, ReceivedStill
from hvt_ground.perception.stills.decode import DecodedStill, decode_still
from hvt_models.redetection import composite
from hvt_scene import CodeInView
from hvt_study.reading.score import LEAST_VISIBLE, Code, CodeReader, Evidence, code_crop, share_inside

Channel = Literal["base", "stills", "composite"]
CHANNELS: tuple[Channel, ...] = ("base", "stills", "composite")
"""The pictures to read: base alone, stills alone, and stills laid over the base picture at the source's size."""

_EVERY_FRAMES = 5
"""Every fifth base picture is read: three a second, as an operator would look at most."""
_REMEMBERED = 45
_MOST_PENDING = 64
INSIDE_SHARE = 0.98
"""How much of a code has to lie in a still for the still to be read alone."""


class CodeObserver:
    """Sees all pictures that a flight's ground receives, at the media time ``at_ns``; changes nothing.

    ``codes`` are all codes to read, by object, and ``views`` the codes in view, by frame of the clip.
    """

    def __init__(
        self,
        codes: Mapping[int, Code],
        views: Sequence[Sequence[CodeInView]],
        *,
        view: View,
        started_ns: int,
        reader: CodeReader,
    ) -> None:
        self._codes = codes
        self._views = views
        self._view = view
        self._started_ns = started_ns
        self._reader = reader
        self._pictures: OrderedDict[int, DecodedFrame] = OrderedDict()
        self._pending: list[ReceivedStill] = []
        self._next_read = 0
        self.evidence: dict[Channel, dict[int, Evidence]] = {channel: {} for channel in CHANNELS}
        """By channel and object. The composite contains the base: it has that reading too."""

    def picture(self, picture: DecodedFrame, *, at_ns: int) -> None:
        """Read the codes due on the base, and the stills that waited for this picture."""
        self._pictures[picture.frame_index] = picture
        while len(self._pictures) > _REMEMBERED:
            self._pictures.popitem(last=False)
        if picture.frame_index >= self._next_read:
            self._next_read = picture.frame_index + _EVERY_FRAMES
            self._read_base(picture, at_ns=at_ns)
        pending, self._pending = self._pending, []
        for still in pending:
            self._take(still, at_ns=at_ns)

    def stills(self, stills: Sequence[ReceivedStill], *, at_ns: int) -> None:
        for still in stills:
            self._take(still, at_ns=at_ns)

    def _read_base(self, picture: DecodedFrame, *, at_ns: int) -> None:
        codes = self._unread("base", picture.frame_index)
        if codes:
            image = as_bgr(picture.picture)
            boxes = self._view.to_base(np.array([code.box_source_px for code in codes], np.float32))
            self._read("base", codes, [code_crop(image, box) for box in boxes.tolist()], at_ns=at_ns)

    def _take(self, still: ReceivedStill, *, at_ns: int) -> None:
        frame_index = still.header.frame_index
        exact = self._pictures.get(frame_index)
        base_bgr = None if exact is None else as_bgr(exact.picture)
        try:
            base = None if exact is None else exact.picture
            image = decode_still(still, base=base, view=self._view)
        except BaseMissingError:
            if len(self._pending) < _MOST_PENDING:  # it may have overtaken its frame
                self._pending.append(still)
            return
        except StillError:
            return
        decoded = DecodedStill(image, still.header.crop_source_px, ((0, 0, 0, 0),), frame_index)
        self._read_still(decoded, at_ns=at_ns)
        self._read_composite(decoded, base_bgr, at_ns=at_ns)

    def _read_still(self, still: DecodedStill, *, at_ns: int) -> None:
        codes = [
            code for code in self._unread("stills", still.frame_index) if _share(code, still) >= INSIDE_SHARE
        ]
        x1, y1, x2, _ = still.crop_source_px
        scale = still.image_bgr.shape[1] / (x2 - x1)
        boxes = [(code.box_source_px - np.array([x1, y1, x1, y1])) * scale for code in codes]
        self._read("stills", codes, [code_crop(still.image_bgr, box.tolist()) for box in boxes], at_ns=at_ns)

    def _read_composite(self, still: DecodedStill, base_bgr: Image | None, *, at_ns: int) -> None:
        """Read the codes that the still shows at least a part of; elsewhere the composite is the base."""
        codes = [code for code in self._unread("composite", still.frame_index) if _share(code, still) > 0]
        if base_bgr is None or not codes:
            return
        zoom = max(1.0, 1 / self._view.scale)
        picture = composite(base_bgr, [still], view=self._view, zoom=zoom)
        boxes = self._view.to_base(np.array([code.box_source_px for code in codes], np.float32)) * zoom
        self._read("composite", codes, [code_crop(picture, box) for box in boxes.tolist()], at_ns=at_ns)

    def _unread(self, channel: Channel, frame_index: int) -> list[CodeInView]:
        """Codes that are whole in view in that frame and were not read right yet."""
        known = self.evidence[channel]
        return [
            code
            for code in self._views[frame_index]
            if code.visible >= LEAST_VISIBLE
            and code.object_id in self._codes
            and not (code.object_id in known and known[code.object_id].right)
        ]

    def _read(
        self, channel: Channel, codes: Sequence[CodeInView], crops: Sequence[Image], *, at_ns: int
    ) -> None:
        at_s = (at_ns - self._started_ns) / 1e9
        shown_in: tuple[Channel, ...] = ("base", "composite") if channel == "base" else (channel,)
        for code, reading in zip(codes, self._reader.read(crops), strict=True):
            for one in shown_in:
                evidence = self.evidence[one].setdefault(code.object_id, Evidence())
                evidence.add(reading, code=code.text, at_s=at_s)


def _share(code: CodeInView, still: DecodedStill) -> float:
    return share_inside(code.box_source_px, np.array(still.crop_source_px, np.float32))
