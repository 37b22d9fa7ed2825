"""Candidates: the tracks of one decision step, each with its crop and the edge's memory of it.

Methods and suppression see only candidates, so that they can be pure functions. The edge decodes its own stream, so
it knows exactly how the ground sees a crop: the gate sends no still where nothing was lost, and M6 first requests the
crops that lost most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from functools import cache

import cv2
import numpy as np

from hvt_common.values import Boxes, Image, Tracks, View
from hvt_common.video.base_crop import MAX_SIDE_PX, base_crop, coded_size

Box = tuple[float, float, float, float]

PADDING = 0.15
"""Share of the box's width and height that is added on each side (the pilot's setting)."""
MIN_SIDE_PX = 8
"""No crop is narrower or lower than one JPEG block."""
MOST_PSNR_DB = 99.0
"""The value for identical crops, where the formula has no finite one."""
_BT601 = np.array([[0.114, 0.587, 0.299]], np.float32)
_DETAIL_SIDE_PX = 224
"""Input size of usual classifiers; the loss of finer detail changes no class."""
_NOISE_ENERGY = 20.0
"""Energy of the Laplacian (0 1 0, 1 -4 1, 0 1 0) of noise of one grey level, 4 · 1 + 16: less is no detail."""


def crop_box(
    box_source_px: tuple[float, float, float, float], *, padding: float, source_size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The padded box in whole source pixels, grown to `MIN_SIDE_PX` and kept inside the frame.

    Rounded outwards, so that no pixel of the box is lost. A source smaller than `MIN_SIDE_PX` gives its whole side.
    """
    x1, x2 = _span(box_source_px[0], box_source_px[2], padding=padding, limit=source_size[0])
    y1, y2 = _span(box_source_px[1], box_source_px[3], padding=padding, limit=source_size[1])
    return x1, y1, x2, y2


def _span(low: float, high: float, *, padding: float, limit: int) -> tuple[int, int]:
    margin = max(0.0, high - low) * padding
    start = min(max(0, math.floor(low - margin)), limit)
    end = max(min(limit, math.ceil(high + margin)), 0)
    short = min(MIN_SIDE_PX, limit) - (end - start)
    if short > 0:
        start = min(max(0, start - (short + 1) // 2), limit - min(MIN_SIDE_PX, limit))
        end = max(end, start + min(MIN_SIDE_PX, limit))
    return start, end


@dataclass(frozen=True, slots=True)
class BaseLoss:
    """The loss of a crop in the base against the source."""

    psnr_y_db: float
    """Luma PSNR of the base crop against the source crop; at most `MOST_PSNR_DB`."""
    detail_lost: float
    """0…1: the share of the source's detail that the base does not show; see `measure_loss`."""


def measure_loss(source_crop: Image, base_crop: Image) -> BaseLoss:
    """Compare two uint8 BGR crops of one size, at least 1x1: the source's and the base's.

    With ``S`` and ``B`` the Laplacians of both lumas (BT.601), ``detail_lost = sum(S (S - B)) / (sum(S S) + noise)``:
    0 where the base has all edges of the source, 1 where it has none of them, 0.5 where it has them at half their
    contrast. Artefacts of the base (ringing, blocks) are no loss of detail; they count in the PSNR. A crop without
    detail loses none: noise of one grey level stands in the denominator. A longer side is shrunk to 224 pixels first
    (area means). 0.03 ms for 64x64 pixels, 0.5 ms for 256x256.
    """
    assert source_crop.shape == base_crop.shape, "both crops have one size"
    # Luma of the difference, not difference of the lumas: rounded to bytes these would be off by up to 5 %.
    luma = cv2.transform(source_crop.astype(np.float32), _BT601)
    lost = cv2.transform(cv2.subtract(source_crop, base_crop, dtype=cv2.CV_32F), _BT601)
    error = float(np.mean(np.square(lost), dtype=np.float64))
    psnr_y_db = MOST_PSNR_DB if error == 0 else min(MOST_PSNR_DB, 10 * math.log10(255**2 / error))
    had, missing = _detail(luma), _detail(lost)
    share = cv2.mean(had * missing)[0] / (cv2.mean(had * had)[0] + _NOISE_ENERGY)
    return BaseLoss(psnr_y_db=psnr_y_db, detail_lost=min(1.0, max(0.0, share)))


def _detail(luma: cv2.typing.MatLike) -> cv2.typing.MatLike:
    # The Laplacian, at the size at which detail counts.
    shrink = max(luma.shape[:2]) / _DETAIL_SIDE_PX
    if shrink > 1:
        size = (max(1, round(luma.shape[1] / shrink)), max(1, round(luma.shape[0] / shrink)))
        luma = cv2.resize(luma, size, interpolation=cv2.INTER_AREA)
    return cv2.Laplacian(luma, cv2.CV_32F)


_BORDER_PX = 2.0
"""A box this near to the edge of the picture counts as cut off by it (base pixels)."""
_LEAVING_SHARE = 0.95
_SHARPNESS_SIDE_PX = 64


@dataclass(frozen=True, slots=True)
class ClassPosterior:
    """The ground classifier's answer for a track, from ``feedback``."""

    class_name: str
    confidence: float
    entropy_nats: float


@dataclass(frozen=True, slots=True)
class Candidate:
    """A track at a decision step."""

    frame_index: int
    track_id: int
    box_base_px: Box
    """Clipped to the picture."""
    box_source_px: Box
    class_id: int
    class_name: str
    confidence: float
    """Confidence of the detection matched last, 0…1."""
    area_share: float
    """Box area over base frame area."""
    crop_area_px: float
    """Pixels that a still of it would code: padded, clipped, bounded in side. The input of the cost estimate."""
    born_frame: int
    started: bool = False
    """Created, or found again after being lost, since the step before."""
    frames_since_start: int = 0
    detected: bool = True
    """A detection of this very frame was matched; False while the box is only predicted."""
    touches_border: bool = False
    border_s: float = 0.0
    """How long it has touched the border without a break."""
    leaving: bool = False
    """The box touches the border, and less of the object shows than before."""
    covered_share: float = 0.0
    """The largest share of the box that one track in front covers; the box that reaches lower down is in front."""
    sent_count: int = 0
    last_sent_frame: int | None = None
    last_sent_ns: int | None = None
    last_sent_area_px: float | None = None
    """Box area in source pixels at the last still."""
    last_sent_sharpness: float | None = None
    last_sent_at_border: bool = False
    last_refused_ns: int | None = None
    """When the still stage last gave no still (`TrackMemory.record_refused`)."""
    posterior: ClassPosterior | None = None
    sharpness: Callable[[], float] | None = field(default=None, compare=False, repr=False)
    """Measures the source crop when called; None where no picture was at hand."""
    loss: Callable[[], BaseLoss] | None = field(default=None, compare=False, repr=False)
    """Measures, once, the base's loss at the crop against the source, on the base's own grid if that is the coarser;
    None where a picture was not at hand."""

    @property
    def area_px(self) -> float:
        x1, y1, x2, y2 = self.box_source_px
        return max(0.0, x2 - x1) * max(0.0, y2 - y1)


def sharpness(crop_bgr: Image) -> float:
    """Variance of the Laplacian at a fixed size: higher is sharper. 0.1 ms.

    The crop is resized to 64 by 64 pixels first, so that an object that comes nearer and shows more detail
    scores higher.
    """
    grey = cv2.cvtColor(crop_bgr, cv2.COLOR_BGR2GRAY)
    small = cv2.resize(grey, (_SHARPNESS_SIDE_PX, _SHARPNESS_SIDE_PX), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())


@dataclass(slots=True)
class _History:
    seen_ns: int
    start_frame: int
    border_since_ns: int | None = None
    border_area_px: float = 0.0
    sent_count: int = 0
    last_sent_frame: int | None = None
    last_sent_ns: int | None = None
    last_sent_area_px: float | None = None
    last_sent_sharpness: float | None = None
    last_sent_at_border: bool = False
    last_refused_ns: int | None = None
    posterior: ClassPosterior | None = None


_REMEMBERED = {one.name for one in fields(_History)} & {one.name for one in fields(Candidate)}
"""The fields that a candidate copies from the history of its track."""


class TrackMemory:
    """Remembers the start of each track, its stills and the ground's answers.

    Bounded: a track not seen for ``forget_s`` is forgotten, and beyond ``max_tracks`` the tracks seen longest ago
    are forgotten first.
    """

    def __init__(self, *, padding: float = PADDING, forget_s: float = 30.0, max_tracks: int = 4096) -> None:
        self._padding = padding
        self._forget_ns = round(forget_s * 1e9)
        self._max_tracks = max_tracks
        self._histories: dict[int, _History] = {}
        self._last_step_frame = -1

    def __len__(self) -> int:
        return len(self._histories)

    def observe(self, tracks: Tracks, *, now_ns: int) -> None:
        """Note the present tracks; call it on every frame, so that no start between two steps is missed."""
        for track_id, started in zip(tracks.ids.tolist(), tracks.started.tolist(), strict=True):
            history = self._histories.get(track_id)
            if history is None:
                # A track that is new here has started as well: the tracker may list it later than it made it.
                history = _History(seen_ns=now_ns, start_frame=tracks.frame_index)
                self._histories[track_id] = history
            elif started:
                history.start_frame = tracks.frame_index
            history.seen_ns = now_ns
        self._forget(now_ns)

    def record_sent(self, candidate: Candidate, *, frame_index: int, now_ns: int) -> None:
        """Note that a still of the candidate was sent; ``frame_index`` is the frame that it shows."""
        history = self._histories.get(candidate.track_id)
        if history is None:
            return
        history.sent_count += 1
        history.last_sent_frame = frame_index
        history.last_sent_ns = now_ns
        history.last_sent_area_px = candidate.area_px
        history.last_sent_sharpness = candidate.sharpness() if candidate.sharpness else None
        history.last_sent_at_border = candidate.touches_border

    def record_refused(self, track_id: int, *, now_ns: int) -> None:
        """Note that the still stage had no still for the track; suppression then lets it rest for a while."""
        history = self._histories.get(track_id)
        if history is not None:
            history.last_refused_ns = now_ns

    def record_feedback(
        self, track_id: int, *, class_name: str, confidence: float, entropy_nats: float
    ) -> None:
        """Note the answer of the ground's classifier for the track; unknown tracks are ignored."""
        history = self._histories.get(track_id)
        if history is not None:
            history.posterior = ClassPosterior(class_name, confidence, entropy_nats)

    def candidates(
        self,
        tracks: Tracks,
        *,
        view: View,
        class_names: Sequence[str],
        now_ns: int,
        source_bgr: Image | None = None,
        base_bgr: Image | None = None,
    ) -> list[Candidate]:
        """One candidate for each track, ordered by id.

        ``source_bgr`` and ``base_bgr``, the decoded base frame of the same index, are read only when sharpness or
        loss is called.
        """
        self.observe(tracks, now_ns=now_ns)
        picture = _picture(view)
        boxes_base = np.clip(tracks.boxes_xyxy_px, picture[:2] * 2, picture[2:] * 2).astype(np.float32)
        boxes_source = view.to_source(boxes_base)
        covered = _covered_shares(boxes_base)
        result = []
        for row, track_id in enumerate(tracks.ids.tolist()):
            history, class_id = self._histories[track_id], int(tracks.class_ids[row])
            box_base_px, box_source_px = tuple(boxes_base[row].tolist()), tuple(boxes_source[row].tolist())
            crop = crop_box(box_source_px, padding=self._padding, source_size=view.source_size)
            coded = coded_size(crop)
            touches, leaving = _note_border(history, box_base_px, picture=picture, now_ns=now_ns)
            x1, y1, x2, y2 = box_base_px
            sharp = loss = None
            if source_bgr is not None:
                sharp = _sharpness_of(source_bgr, crop)
                loss = None if base_bgr is None else _loss_of(source_bgr, base_bgr, crop, view=view)
            result.append(
                Candidate(
                    frame_index=tracks.frame_index,
                    track_id=track_id,
                    box_base_px=box_base_px,
                    box_source_px=box_source_px,
                    class_id=class_id,
                    class_name=class_names[class_id] if 0 <= class_id < len(class_names) else str(class_id),
                    confidence=float(tracks.confidences[row]),
                    area_share=(x2 - x1) * (y2 - y1) / (view.base_size[0] * view.base_size[1]),
                    crop_area_px=float(coded[0] * coded[1]),
                    born_frame=int(tracks.born_frames[row]),
                    started=history.start_frame > self._last_step_frame,
                    frames_since_start=tracks.frame_index - history.start_frame,
                    detected=bool(tracks.seen_frames[row] == tracks.frame_index),
                    touches_border=touches,
                    border_s=0.0
                    if history.border_since_ns is None
                    else (now_ns - history.border_since_ns) / 1e9,
                    leaving=leaving,
                    covered_share=covered[row],
                    **{name: getattr(history, name) for name in _REMEMBERED},
                    sharpness=sharp,
                    loss=loss,
                )
            )
        self._last_step_frame = tracks.frame_index
        return result

    def _forget(self, now_ns: int) -> None:
        oldest_ns = now_ns - self._forget_ns
        for track_id in [key for key, history in self._histories.items() if history.seen_ns < oldest_ns]:
            del self._histories[track_id]
        if len(self._histories) > self._max_tracks:
            by_age = sorted(self._histories, key=lambda key: (self._histories[key].seen_ns, key))
            for track_id in by_age[: len(by_age) - self._max_tracks]:
                del self._histories[track_id]


def _picture(view: View) -> Box:
    # The source's area inside the base frame, base pixels; letterbox borders are not picture.
    x1, y1, x2, y2 = view.to_base(np.array([[0, 0, *view.source_size]], np.float32))[0].tolist()
    return max(x1, 0.0), max(y1, 0.0), min(x2, float(view.base_size[0])), min(y2, float(view.base_size[1]))


def _note_border(history: _History, box_base_px: Box, *, picture: Box, now_ns: int) -> tuple[bool, bool]:
    # (touches the border, is leaving); a track leaves while less of it shows than at best since it touched.
    low_x, low_y, high_x, high_y = picture
    x1, y1, x2, y2 = box_base_px
    near = _BORDER_PX
    if x1 - low_x > near and y1 - low_y > near and high_x - x2 > near and high_y - y2 > near:
        history.border_since_ns, history.border_area_px = None, 0.0
        return False, False
    if history.border_since_ns is None:
        history.border_since_ns = now_ns
    area = (x2 - x1) * (y2 - y1)
    history.border_area_px = max(history.border_area_px, area)
    return True, area < _LEAVING_SHARE * history.border_area_px


def _covered_shares(boxes_base_px: Boxes) -> list[float]:
    # Share covered by a box that reaches lower down, hence stands in front; from straight above boxes hardly overlap.
    if not len(boxes_base_px):
        return []
    x1, y1, x2, y2 = boxes_base_px.T
    shares = []
    for row, area in enumerate(((x2 - x1) * (y2 - y1)).tolist()):
        width = np.minimum(x2, x2[row]) - np.maximum(x1, x1[row])
        height = np.minimum(y2, y2[row]) - np.maximum(y1, y1[row])
        shared = np.maximum(width, 0) * np.maximum(height, 0)
        shared[y2 <= y2[row]] = 0
        shares.append(min(1.0, float(shared.max()) / area) if area > 0 else 0.0)
    return shares


def _sharpness_of(source_bgr: Image, crop_source_px: tuple[int, int, int, int]) -> Callable[[], float]:
    x1, y1, x2, y2 = crop_source_px
    return lambda: sharpness(source_bgr[y1:y2, x1:x2])


def _loss_of(
    source_bgr: Image, base_bgr: Image, crop_source_px: tuple[int, int, int, int], *, view: View
) -> Callable[[], BaseLoss]:
    # Measures the loss by coding, not by the size of the base: detectors there work on its grid and no finer.
    x1, y1, x2, y2 = crop_source_px
    shrink = max(1.0, 1 / view.scale, max(x2 - x1, y2 - y1) / MAX_SIDE_PX)
    size = (max(1, round((x2 - x1) / shrink)), max(1, round((y2 - y1) / shrink)))

    @cache
    def loss() -> BaseLoss:
        crop = source_bgr[y1:y2, x1:x2]
        if size != (x2 - x1, y2 - y1):
            crop = np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA), np.uint8)
        shown = base_crop(base_bgr, view=view, crop_source_px=crop_source_px, size=size)
        return measure_loss(crop, shown)

    return loss
