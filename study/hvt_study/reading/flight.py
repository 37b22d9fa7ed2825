"""One flight that is read: the edge and ground of the study with a reader beside them; cached, never flown twice.

The reader reads arriving base pictures, stills and the composite. Of the truth it gets one thing: the box around a
code at the frame that a picture shows. It does not learn which way the code is turned, how many characters it has, or
which ones may occur.
"""

import base64
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from hvt_common.errors import UserError
from hvt_common.protocol.messages import Info
from hvt_common.transport.inbox import Received
from hvt_common.values import Image, View
from hvt_common.video.still_codecs import BaseMissingError, StillError
from hvt_ground.perception.history import as_bgr
from hvt_ground.perception.pipeline import DecodedFrame, ReceivedStill
from hvt_ground.perception.stills.decode import DecodedStill, decode_still
from hvt_ground.perception.worker import Analyze, LockstepWorker, Read, Step
from hvt_models.redetection import composite
from hvt_scene import CodeInView
from hvt_study.cache.results import ResultCache, content_key
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.flights.flight import Flight
from hvt_study.flights.flight_ground import GroundSide, SharedModels
from hvt_study.flights.flight_link import SerialLink
from hvt_study.reading.score import (
    LEAST_VISIBLE,
    Code,
    CodeReader,
    Evidence,
    Reading,
    code_crop,
    codes_to_read,
    share_inside,
)
from hvt_study.runs.run_context import open_run_context, software_versions
from hvt_study.runs.run_settings import dry_run_bps, edge_flags, flight_plan
from hvt_study.runs.spec import RunSpec
from hvt_study.runs.video_shape import VideoShape, match, within

Channel = Literal["base", "stills", "composite"]
CHANNELS: tuple[Channel, ...] = ("base", "stills", "composite")
"""The pictures to read: base alone, stills alone, and stills laid over the base picture at the source's size."""

_EVERY_FRAMES = 5
"""Every fifth picture of the base, and of the source, is read: three a second, as an operator would look at most."""
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
        return _unread(self._views[frame_index], self._codes, self.evidence[channel])

    def _read(
        self, channel: Channel, codes: Sequence[CodeInView], crops: Sequence[Image], *, at_ns: int
    ) -> None:
        at_s = (at_ns - self._started_ns) / 1e9
        shown_in: tuple[Channel, ...] = ("base", "composite") if channel == "base" else (channel,)
        _read(self._reader, codes, crops, [self.evidence[one] for one in shown_in], at_s=at_s)


def _unread(
    views: Sequence[CodeInView], codes: Mapping[int, Code], known: Mapping[int, Evidence]
) -> list[CodeInView]:
    """Codes that are whole in view and were not read right yet."""
    seen = (one for one in views if one.visible >= LEAST_VISIBLE and one.object_id in codes)
    return [one for one in seen if not (one.object_id in known and known[one.object_id].right)]


def _read(
    reader: CodeReader,
    codes: Sequence[CodeInView],
    crops: Sequence[Image],
    evidence: Sequence[dict[int, Evidence]],
    *,
    at_s: float,
) -> None:
    for code, reading in zip(codes, reader.read(crops), strict=True):
        for known in evidence:
            known.setdefault(code.object_id, Evidence()).add(reading, code=code.text, at_s=at_s)


def _share(code: CodeInView, still: DecodedStill) -> float:
    return share_inside(code.box_source_px, np.array(still.crop_source_px, np.float32))


@dataclass(frozen=True, slots=True)
class ReadFlight:
    """The cost of a flight, and its readings."""

    size: tuple[int, int]
    """(width, height) of the base stream; of the source where that was read itself."""
    fps: float
    total_bps: int
    base_bps: int
    roi_bps: int
    evidence: Mapping[Channel, Mapping[int, Evidence]]


class Readings:
    """Flights over one sequence that has codes, each flown and read once in the life of the cache.

    Raises `UserError` where no code is in view long enough, or a model cannot be used.
    """

    def __init__(self, spec: RunSpec, *, reader: CodeReader, cache: Path) -> None:
        self._context = open_run_context(spec, cache=cache)
        sequence = self._context.sequence
        assert sequence.codes is not None, "whoever calls has looked"
        self._views = [sequence.codes(sequence.source_frame(index)) for index in range(sequence.clip_frames)]
        self.codes = codes_to_read(self._views)
        if not self.codes:
            raise UserError(f"{spec.sequence} shows no code for a second: give more --max-frames")
        self._reader = reader
        self._cache = ResultCache(cache / "readings")

    @property
    def source_size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._context.sequence.source_size

    def source(self) -> ReadFlight:
        """The readings of the source itself: the most that any link could show."""

        def read() -> ReadFlight:
            evidence: dict[int, Evidence] = {}
            with_codes = zip(self._context.sequence.clip.images(), self._views, strict=False)
            for frame_index, (image, views) in enumerate(with_codes):
                if frame_index % _EVERY_FRAMES == 0:
                    codes = _unread(views, self.codes, evidence)
                    crops = [code_crop(image, one.box_source_px.tolist()) for one in codes]
                    _read(self._reader, codes, crops, [evidence], at_s=frame_index / NOMINAL_FPS)
            return ReadFlight(self.source_size, NOMINAL_FPS, 0, 0, 0, {"base": evidence})

        return self._known(("source",), read)

    def flown(self, spec: RunSpec, *, budget_bps: int, fps: float | None) -> ReadFlight:
        """Fly and read; `UserError` where the edge refuses the settings."""
        flags = edge_flags(spec, budget_bps=budget_bps, shape=VideoShape(fps))
        key = (flags, spec.budget_bps, spec.detect_every, asdict(spec.models))
        return self._known(key, lambda: self._fly(spec, budget_bps=budget_bps, fps=fps))

    def matched(self, spec: RunSpec, *, target_bps: int, fps: float | None) -> ReadFlight | None:
        """Video that spends the same as another method, within one per cent; None where no budget does."""

        def spends(budget_bps: int) -> float | None:
            shape = VideoShape(fps)

            def dry_run() -> dict[str, float | None]:
                try:
                    return {"bps": dry_run_bps(spec, self._context, budget_bps=budget_bps, shape=shape)}
                except UserError:
                    return {"bps": None}

            flags = edge_flags(spec, budget_bps=budget_bps, shape=shape)
            bps = self._cache.known(content_key("weight", flags, self._content()), dry_run)["bps"]
            return None if bps is None else float(bps)

        found = match(spends, target_bps=target_bps)
        if found is None or not within(found.total_bps, target_bps):
            return None
        return self.flown(spec, budget_bps=found.budget_bps, fps=fps)

    def _fly(self, spec: RunSpec, *, budget_bps: int, fps: float | None) -> ReadFlight:
        context = self._context
        plan = flight_plan(spec, context, budget_bps=budget_bps, shape=VideoShape(fps))
        observers: list[CodeObserver] = []

        def ground(info: Info, link: SerialLink[Received]) -> GroundSide:
            observer = CodeObserver(
                self.codes, self._views, view=info.view, started_ns=info.started_ns, reader=self._reader
            )
            observers.append(observer)
            models = SharedModels(context.detector, context.classifier)
            return _ReadGround(info, observer=observer, config=plan.ground, models=models, link=link)

        flight = Flight(plan, detector=context.edge_detector, make_ground=ground)
        flight.run()
        report = flight.report(saved_cpu_s=0.0)
        return ReadFlight(
            size=spec.size,
            fps=report.messages.get("base", 0) / report.duration_s,
            total_bps=report.bps(),
            base_bps=report.bps("base"),
            roi_bps=report.bps("roi"),
            evidence=observers[0].evidence,
        )

    def _known(self, key: tuple[Any, ...], make: Callable[[], ReadFlight]) -> ReadFlight:
        name = content_key("read", key, self._content())
        return _unpacked(self._cache.known(name, lambda: _packed(make())))

    def _content(self) -> tuple[Any, ...]:
        """All that decides a flight beside its settings."""
        context = self._context
        return context.content, context.sequence.clip_frames, software_versions(), self._reader.name


class _ReadGround(GroundSide):
    """Shows arriving pictures to the observer."""

    def __init__(self, info: Info, *, observer: CodeObserver, **named: Any) -> None:
        self._observer = observer
        super().__init__(info, **named)

    def _make_worker(self, analyze: Analyze, step: Step, read: Read) -> LockstepWorker:
        def analyze_observed(picture: DecodedFrame, *how: Any) -> None:
            self._observer.picture(picture, at_ns=self.now_ns)
            analyze(picture, *how)

        def read_observed(stills: Sequence[ReceivedStill]) -> None:
            self._observer.stills(stills, at_ns=self.now_ns)
            read(stills)

        return super()._make_worker(analyze_observed, step, read_observed)


# The cache


def _packed(flight: ReadFlight) -> dict[str, Any]:
    return {
        "size": list(flight.size),
        **{name: getattr(flight, name) for name in ("fps", "total_bps", "base_bps", "roi_bps")},
        "evidence": {
            channel: {str(object_id): _packed_evidence(one) for object_id, one in found.items()}
            for channel, found in flight.evidence.items()
        },
    }


def _unpacked(known: Mapping[str, Any]) -> ReadFlight:
    evidence = {
        channel: {
            int(object_id): _unpacked_evidence(one)
            for object_id, one in known["evidence"].get(channel, {}).items()
        }
        for channel in CHANNELS
    }
    return ReadFlight(**{**known, "size": tuple(known["size"]), "evidence": evidence})


def _packed_evidence(one: Evidence) -> dict[str, Any]:
    assert one.best is not None, "it was made for a reading"
    return {
        "read_s": one.read_s if one.right else None,
        "text": one.best.text,
        "confidence": one.best.confidence,
        "picture": base64.b64encode(cv2.imencode(".png", one.best.picture_bgr)[1].tobytes()).decode(),
    }


def _unpacked_evidence(known: Mapping[str, Any]) -> Evidence:
    coded = np.frombuffer(base64.b64decode(known["picture"]), np.uint8)
    picture = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
    read_s = math.inf if known["read_s"] is None else known["read_s"]
    return Evidence(read_s, Reading(known["text"], known["confidence"], picture))
