"""One flight that is read: the edge and ground of the study with a reader beside them; cached, never flown twice."""

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_common.errors import UserError
from hvt_common.protocol.messages import Info
from hvt_common.transport.inbox import Received
from hvt_common.values import Image
from hvt_ground.perception.pipeline import DecodedFrame, ReceivedStill
from hvt_ground.perception.worker import Analyze, LockstepWorker, Read, Step
from hvt_scene import CodeInView
from hvt_study.cache.results import ResultCache, content_key
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.flights.flight import Flight
from hvt_study.flights.flight_ground import GroundSide, SharedModels
from hvt_study.flights.flight_link import SerialLink
from hvt_study.reading.observer import CHANNELS, Channel, CodeObserver
from hvt_study.reading.score import LEAST_VISIBLE, CodeReader, Evidence, Reading, code_crop, codes_to_read
from hvt_study.runs.run_context import open_run_context, software_versions
from hvt_study.runs.run_settings import dry_run_bps, edge_flags, flight_plan
from hvt_study.runs.spec import RunSpec
from hvt_study.runs.video_shape import VideoShape, match, within

_EVERY_FRAMES = 5  # of the source, as of the base


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
                    self._read_source(image, views, evidence, at_s=frame_index / NOMINAL_FPS)
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

    def _read_source(
        self, image: Image, views: tuple[CodeInView, ...], evidence: dict[int, Evidence], *, at_s: float
    ) -> None:
        views = tuple(
            one
            for one in views
            if one.object_id in self.codes
            and one.visible >= LEAST_VISIBLE
            and not (one.object_id in evidence and evidence[one.object_id].right)
        )
        crops = [code_crop(image, one.box_source_px.tolist()) for one in views]
        for one, reading in zip(views, self._reader.read(crops), strict=True):
            found = evidence.setdefault(one.object_id, Evidence())
            found.add(reading, code=one.text, at_s=at_s)

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
