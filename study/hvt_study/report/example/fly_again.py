"""Flies one run of a study again, to look at it: the rows of a table hold no pixels.

The flight is the very same, to the bit; only the ground's side is asked to keep the pictures of its stills.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice
from typing import Any

import cv2
import numpy as np

from hvt_common.protocol.channels import Channel, parse_key
from hvt_common.protocol.messages import Info, RoiHeader
from hvt_common.transport.inbox import Received
from hvt_common.values import Image, View
from hvt_common.video.base_crop import base_crop
from hvt_common.video.still_codecs import psnr_y_db
from hvt_ground.events import Event, Refinement
from hvt_study.datasets.labels import NO_ID
from hvt_study.datasets.sequence import NOMINAL_FPS, Clip
from hvt_study.flights.flight import Flight, FlightPlan, FlightReport
from hvt_study.flights.flight_ground import GroundSide, SharedModels
from hvt_study.flights.flight_link import Arrival
from hvt_study.matrix.plan import StudyPlan
from hvt_study.metrics.classes import class_score
from hvt_study.metrics.judged import judged
from hvt_study.metrics.observed import refined_frames, refined_objects
from hvt_study.report.example import choice
from hvt_study.runs.run_context import RunContext, open_run_context
from hvt_study.runs.run_settings import flight_plan
from hvt_study.runs.spec import RunSpec
from hvt_study.runs.video_shape import VideoShape

_MOST_STILLS = 2000
_MOST_LANES = 14
_SECOND_FRAMES = round(NOMINAL_FPS)
_BEST_DB = 99.0
"""Stands for a still without any loss."""


def fly_again(spec: RunSpec, plan: StudyPlan, *, rule: str) -> choice.Example:
    """Fly the run of `choose_run` once more; ``rule`` says why this one.

    Raises `UserError` where dataset or models cannot be used, or the edge refuses its settings.
    """
    context = open_run_context(spec, cache=plan.cache)
    flight = flight_plan(spec, context, budget_bps=spec.budget_bps, shape=VideoShape())
    title = f"{spec.sequence}, {spec.method} {spec.still_codec}, {spec.regime} regime, {spec.labels} labels"
    return example_of(flight, context, key=spec.key, rule=rule, title=title)


def example_of(flight: FlightPlan, context: RunContext, *, key: str, rule: str, title: str) -> choice.Example:
    """Fly, and look at it; `UserError` where the edge refuses its settings."""
    models = SharedModels(context.detector, context.classifier)
    again = Flight(
        flight,
        detector=context.edge_detector,
        make_ground=lambda info, link: _WatchedGround(info, config=flight.ground, models=models, link=link),
    )
    again.run()
    ground = again.ground
    report = again.report(saved_cpu_s=0.0)
    crops = list(_compared(ground.shown, flight.clip, view=ground.view))
    rows = choice.percentile_rows([crop.gain_db for crop in crops])
    return choice.Example(
        key=key,
        digest=report.digest,
        rule=rule,
        title=title,
        stills=len(crops),
        crops=tuple(replace(crops[index], percentile=percentile) for percentile, index in rows),
        timeline=_timeline(report, ground, context, budget_bps=flight.link_bps),
    )


_Shown = tuple[Refinement, RoiHeader]
"""A still as the ground had it."""


class _WatchedGround(GroundSide):
    """Keeps the pixels of the first object of each still."""

    def __init__(self, info: Info, **named: Any) -> None:
        self._events: dict[int, Refinement] = {}
        self.view = info.view
        self.started_ns = info.started_ns
        super().__init__(info, **named)

    @property
    def shown(self) -> list[_Shown]:
        """Stills with pixels, in order of their numbers."""
        headers = {
            header.sequence: header
            for arrival in self.arrivals
            if _row_of(arrival) is Channel.ROI
            for header in [RoiHeader.parse(arrival.message.attachment, arrival.message.payload)]
        }
        return [(event, headers[number]) for number, event in sorted(self._events.items())]

    def _observed_by(self, emit: Callable[[Event], None]) -> Callable[[Event], None]:
        tell = super()._observed_by(emit)

        def watch(event: Event) -> None:
            if (
                isinstance(event, Refinement)
                and len(self._events) < _MOST_STILLS
                and event.still_bgr is not None
                and event.base_crop_bgr is not None
            ):
                self._events.setdefault(event.still_sequence, event)
            tell(event)

        return watch


def _compared(stills: Sequence[_Shown], clip: Clip, *, view: View) -> Iterator[choice.CropExample]:
    """Each still against the source frame that it was cut from; frames are read once, one at a time."""
    by_frame: dict[int, list[_Shown]] = {}
    for event, header in stills:
        by_frame.setdefault(header.frame_index, []).append((event, header))
    with closing(clip.images()) as images:
        for frame_index, image in enumerate(islice(images, max(by_frame, default=-1) + 1)):
            for one in by_frame.get(frame_index, ()):
                yield _crop(one, np.asarray(image), view=view)


def _crop(one: _Shown, source_bgr: Image, *, view: View) -> choice.CropExample:
    event, header = one
    still, patch = event.still_bgr, event.base_crop_bgr
    assert still is not None, "only those with pixels are kept"
    assert patch is not None, "only those with pixels are kept"
    x1, y1, x2, y2 = header.crop_source_px
    size = still.shape[1], still.shape[0]
    source = source_bgr[y1:y2, x1:x2]
    if (x2 - x1, y2 - y1) != size:
        source = np.asarray(cv2.resize(source, size, interpolation=cv2.INTER_AREA), np.uint8)
    base = base_crop(
        patch, view=_view_of(patch, header.crop_source_px, view), crop_source_px=(x1, y1, x2, y2), size=size
    )
    base_db, still_db = (min(_BEST_DB, psnr_y_db(image, source)) for image in (base, still))
    return choice.CropExample(
        percentile=0,
        gain_db=still_db - base_db,
        base_db=base_db,
        at_s=header.frame_index / NOMINAL_FPS,
        track_id=event.edge_track_id,
        class_before=event.class_before,
        class_after=event.class_after,
        size_bytes=len(event.still),
        source_png=choice.png_of(source),
        base_png=choice.png_of(base),
        still_png=choice.png_of(still),
    )


def _view_of(patch: Image, crop_source_px: tuple[int, int, int, int], view: View) -> View:
    """The map from source to a patch of the base frame: whole pixels around the crop, clipped at the frame."""
    left, top = np.floor(view.to_base(np.array([crop_source_px], np.float32))[0, :2]).clip(0).tolist()
    offset = view.offset_px[0] - left, view.offset_px[1] - top
    return replace(view, base_size=(patch.shape[1], patch.shape[0]), offset_px=offset)


def _timeline(
    report: FlightReport, ground: _WatchedGround, context: RunContext, *, budget_bps: int
) -> choice.Timeline:
    seconds = -(-len(report.lists) // _SECOND_FRAMES)
    kbps = _rates(ground.arrivals, started_ns=ground.started_ns, seconds=seconds)
    lanes = list(_lanes(report))
    return choice.Timeline(
        budget_bps=budget_bps,
        base_kbps=kbps["base"],
        roi_kbps=kbps["roi"],
        other_kbps=kbps["other"],
        **_scores(report, context),
        lanes=tuple(sorted(lanes, key=_interest)[:_MOST_LANES]),
        tracks_named=len(lanes),
    )


def _rates(
    arrivals: Sequence[Arrival[Received]], *, started_ns: int, seconds: int
) -> Mapping[str, tuple[float, ...]]:
    """Kilobits handed to the link in each second; bytes after the last frame are the last second's."""
    size_bytes: Counter[tuple[str, int]] = Counter()
    for one in arrivals:
        row = _row_of(one)
        second = min(seconds - 1, max(0, (one.enter_ns - started_ns) // 1_000_000_000))
        size_bytes[str(row.value) if row in (Channel.BASE, Channel.ROI) else "other", second] += (
            one.size_bytes
        )
    return {
        name: tuple(size_bytes[name, second] * 8 / 1e3 for second in range(seconds))
        for name in ("base", "roi", "other")
    }


def _scores(report: FlightReport, context: RunContext) -> dict[str, tuple[float, ...]]:
    """Scores of each second, by the metrics of the table."""
    listed, known = refined_frames(report.lists, context.labels), context.classes
    frames = judged(listed, word=known.word, classes=known.classes)
    parts = [frames[first : first + _SECOND_FRAMES] for first in range(0, len(frames), _SECOND_FRAMES)]
    after = [class_score(part) for part in parts]
    before = [class_score(part, refined=False) for part in parts]
    return {
        "f1": tuple(one.f1 for one in after),
        "named_before": tuple(one.counts.top1_all for one in before),
        "named": tuple(one.counts.top1_all for one in after),
    }


def _lanes(report: FlightReport) -> Iterator[choice.Lane]:
    words: dict[int, list[choice.Word]] = {}
    for done in refined_objects(report.lists):
        if done.track_id != NO_ID:
            words.setdefault(done.track_id, []).append(
                choice.Word(done.at_s, done.name_before, done.name_after)
            )
    for track_id, said in words.items():
        listed = [bool((one.ids == track_id).any()) for one in report.lists]
        yield choice.Lane(track_id, tuple(_spans(listed)), tuple(said))


def _interest(lane: choice.Lane) -> tuple[int, int, int]:
    """Tracks whose class changed come first."""
    changes = sum(word.before != word.after for word in lane.words)
    return -changes, -len(lane.words), lane.track_id


def _spans(listed: Sequence[bool]) -> Iterator[tuple[float, float]]:
    edges = np.flatnonzero(np.diff([0, *map(int, listed), 0]))
    for first, last in edges.reshape(-1, 2).tolist():
        yield first / NOMINAL_FPS, last / NOMINAL_FPS


def _row_of(arrival: Arrival[Received]) -> Channel | None:
    return (parse_key(arrival.message.key) or ("", None))[1]
