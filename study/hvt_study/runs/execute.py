"""One run, from its specification to its row, in whatever process the pool gives; all they share is the cache.

`figures` makes those of a row, from a flight and its labels.
"""

import json
import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from hvt_common.errors import FlightError, UserError
from hvt_common.protocol.channels import Channel
from hvt_study.cache.results import CacheError, ResultCache, content_key
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.flights.flight import FlightReport
from hvt_study.metrics import observed
from hvt_study.metrics.bits import line_rates, still_counts
from hvt_study.metrics.classes import class_score, first_correct
from hvt_study.metrics.detection import detection_score
from hvt_study.metrics.judged import Judged, judged
from hvt_study.metrics.tracking import continuity, tracking_score
from hvt_study.runs.methods import METHODS
from hvt_study.runs.run_context import Materials, RunContext, begin_study, open_materials, open_run_context
from hvt_study.runs.run_settings import dry_run_bps, edge_flags, flown, settings
from hvt_study.runs.spec import COLUMNS, RunSpec, located
from hvt_study.runs.video_shape import VideoShape, competing_sizes, first_budget, match, search_shape, within

_DIGITS = 6
_RATES = ("total_bps", "base_bps", "roi_bps")
_SAYS_OF_ONE = {
    *("recall", "recall_half_1", "recall_half_2", "top1_before", "top1", "top1_half_1", "top1_half_2"),
    *("top1_all_before", "top1_all", "found_share", "gaps", "longest_gap_s", "id_switches"),
    *("first_correct_p50_s", "first_correct_p90_s", "first_correct_never"),
}
"""Figures that labels of one target allow: nobody knows whether the rest of the list is right."""


_OF_A_LIST = ("named_f1", "false_per_frame", "recall", "precision", "f1")


def figures(report: FlightReport, context: RunContext) -> dict[str, Any]:
    """Every metric column of `hvt_study.runs.spec.COLUMNS`; None where a run has none."""
    labelled = _labelled(report, context)
    if context.sequence.one_target:
        labelled = {name: value if name in _SAYS_OF_ONE else None for name, value in labelled.items()}
    found = {**_bits(report, context), **labelled, **_delays(report)}
    found |= {
        **observed.proxies(observed.refined_objects(report.lists)),
        "digest": report.digest,
        "edge_cpu_ms": report.edge_cpu_ms,
    }
    return {name: _plain(value) for name, value in found.items()}


def _bits(report: FlightReport, context: RunContext) -> dict[str, Any]:
    seconds, clip_s = report.duration_s, context.sequence.duration_s
    span, pilot = (line_rates(report.line_bytes, seconds=one) for one in (seconds, clip_s))
    # Of a server its questions, which are one row of the line bytes.
    back_bytes = report.back_bytes + report.line_bytes.get(Channel.CONTROL, 0)
    return {
        "duration_s": seconds,
        "clip_s": clip_s,
        **{name: round(value) for name, value in span.items()},
        "back_bps": round(8 * back_bytes / seconds),
        **{f"{name}_pilot": round(pilot[name]) for name in _RATES},
        "fps": report.messages.get("base", 0) / seconds,
        **still_counts(
            observed.arrivals(report.lists), observed.refined_objects(report.lists), seconds=seconds
        ),
    }


def _labelled(report: FlightReport, context: RunContext) -> dict[str, Any]:
    words: dict[str, Any] = {"word": context.classes.word, "classes": context.classes.classes}
    if context.sequence.one_target:  # a box of any class finds it
        words["classes"] = None
    frames = judged(observed.refined_frames(report.lists, context.labels), **words)
    detection = detection_score(judged(observed.detected_frames(report.lists, context.labels), **words))
    after, before = class_score(frames), class_score(frames, refined=False)
    tracking, held = tracking_score(frames), continuity(frames)
    first = first_correct(frames, fps=NOMINAL_FPS, shown_s=[one.shown_s for one in report.lists])
    return {
        "map_50": detection.mean.at_50,
        "map_50_95": detection.mean.at_50_95,
        **{f"map_50_{size}": one.at_50 for size, one in detection.by_size.items()},
        "named_f1_before": before.named_f1,
        **{name: getattr(after, name) for name in _OF_A_LIST},
        "top1_before": before.counts.top1_found,
        "top1": after.counts.top1_found,
        "top1_all_before": before.counts.top1_all,
        "top1_all": after.counts.top1_all,
        **_halves(frames),
        "macro_f1_before": before.macro_f1_found,
        "macro_f1": after.macro_f1_found,
        "macro_f1_all_before": before.macro_f1_all,
        "macro_f1_all": after.macro_f1_all,
        **{f"top1_{size}": one.top1_found for size, one in after.by_size.items()},
        **{f"top1_all_{size}": one.top1_all for size, one in after.by_size.items()},
        "mota": tracking.mota,
        "idf1": tracking.idf1,
        "hota": tracking.hota,
        "id_switches": None if held.gaps is None else tracking.switches,
        "found_share": held.found_share,
        "gaps": held.gaps,
        "longest_gap_s": None if held.longest_gap is None else held.longest_gap / NOMINAL_FPS,
        "first_correct_p50_s": first.median_s,
        "first_correct_p90_s": first.p90_s,
        "first_correct_never": first.never / first.tracks if first.tracks else None,
    }


def _halves(frames: Sequence[Judged]) -> dict[str, float]:
    """Scores of the list in each half of the clip: a setting tuned on one half must hold in the other."""
    middle = len(frames) // 2
    found: dict[str, float] = {}
    for half, part in enumerate((frames[:middle], frames[middle:]), start=1):
        one = class_score(part)
        found |= {f"{name}_half_{half}": getattr(one, name) for name in _OF_A_LIST}
        found[f"top1_half_{half}"] = one.counts.top1_found
    return found


def _delays(report: FlightReport) -> dict[str, Any]:
    still_p50_ms, still_p95_ms = observed.still_delays_ms(observed.arrivals(report.lists))
    return {
        "delay_p50_ms": report.link.delay_p50_ms,
        "delay_p95_ms": report.link.delay_p95_ms,
        "still_delay_p50_ms": still_p50_ms,
        "still_delay_p95_ms": still_p95_ms,
        "picture_age_p95_ms": report.picture_age_p95_ms,
        "worst_queue_bytes": report.link.worst_queue_bytes,
        "max_frame_bytes": report.max_frame_bytes,
    }


def _plain(value: Any) -> Any:
    """No NaN, no digits that nobody can repeat; a wait that never ended stays infinite, or means would flatter."""
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, _DIGITS)
    return value


RunRow = dict[str, Any]
_T = TypeVar("_T")
_log = logging.getLogger(__name__)
_STUDY = uuid4().hex
_in_flight = threading.Lock()
"""Flights of one process take turns with its detectors; a Dask worker may have several threads."""


def runner(cache: Path) -> Callable[[RunSpec], RunRow]:
    """`run_spec` for the study of this process, to be called in workers that may have been started elsewhere."""
    return partial(run_spec, cache=cache, folder=Path.cwd(), study=_STUDY)


def run_spec(spec: RunSpec, *, cache: Path, folder: Path = Path(), study: str = "") -> RunRow:
    """Do one run; a refusal of the edge, or an unforeseen error, becomes a row that says so.

    Paths that are not absolute begin at ``folder``, such as the one in which the study was started; of the same
    ``study`` a file is read again where its time or size has changed. A `UserError` ends it: dataset or models cannot
    be used, or the cache not be written.
    """
    with _in_flight:
        begin_study(study)
        here = located(spec, folder=folder)
        found = open_materials(here, cache=cache)
        flights = _Flights(spec, cache, found, here)
        try:
            row = flights.best()
            failed = "" if _matches(spec, row) else _missed(spec, row)
        except (_RefusedError, _BrokenError) as error:
            row, failed = {}, str(error)
    row = {**row, **_identity(spec), "failed": failed, "matched": not failed, "wall_s": flights.wall_s}
    row["config"] = json.dumps({"run": asdict(spec), **row.pop("settings", {})})
    row |= {"versions": json.dumps(found.software), "content": json.dumps(found.content)}
    return {column.name: row.get(column.name) for column in COLUMNS}


class _RefusedError(Exception):
    """The edge does not take these settings; the run is a failed one, the study goes on."""


class _BrokenError(Exception):
    """A flight ended in an error that nobody has foreseen: the run has failed at whatever rate, the study goes on."""


class _Flights:
    """The flights of one run, each done once in the life of the cache.

    They fly with the paths of ``here``, and are remembered in the words of ``spec``.
    """

    def __init__(self, spec: RunSpec, cache: Path, found: Materials, here: RunSpec) -> None:
        self._spec, self._folder, self._found, self._here = spec, cache, found, here
        self._cache = ResultCache(cache / "flights")
        self.wall_s = 0.0

    def best(self) -> RunRow:
        """The flight that counts; of several frame rates and sizes the one that shows most.

        Where sizes are tried too, each shape is flown at about the total to be matched, and the best one alone is
        matched: several codings of each would take a study's whole time.
        """
        method, spec = METHODS[self._spec.method], self._spec
        if not method.fps_choices:
            return self._in_shape(VideoShape())
        about = first_budget(spec.target.total_bps) if method.any_size and spec.target is not None else None
        tried: dict[VideoShape, RunRow] = {}
        refused: list[_RefusedError] = []

        def fly(shape: VideoShape) -> tuple[float, float] | None:
            try:
                row = self._in_shape(shape) if about is None else self._flight(about, shape)
            except _RefusedError as error:  # in this shape; others may do
                refused.append(error)
                return None
            tried[shape] = row
            return _worth(row) if about is not None or _matches(spec, row) else None

        sizes = (
            competing_sizes(spec.size, self._found.sequence.source_size) if method.any_size else (spec.size,)
        )
        search_shape(fly, rates=method.fps_choices, sizes=sizes, nominal=spec.size)
        if not tried:
            raise refused[-1]  # of the slowest, for which there was most hope
        fitting = [shape for shape, row in tried.items() if about is not None or _matches(spec, row)]
        shape = max(fitting or tried, key=lambda one: _worth(tried[one]))
        return tried[shape] if about is None else self._in_shape(shape)

    def _in_shape(self, shape: VideoShape) -> RunRow:
        spec = self._spec
        if spec.target is None:
            return self._flight(spec.budget_bps, shape)
        refused: list[_RefusedError] = []

        def spends(budget_bps: int) -> float | None:
            try:
                return self._weight(budget_bps, shape)
            except _RefusedError as error:
                refused.append(error)
                return None

        found = match(spends, target_bps=spec.target.total_bps)
        if found is None:
            raise refused[0]
        return self._flight(found.budget_bps, shape)

    def _flight(self, budget_bps: int, shape: VideoShape) -> RunRow:
        def fly(context: RunContext) -> RunRow:
            report = _or_refused(lambda: flown(self._here, context, budget_bps=budget_bps, shape=shape))
            used = settings(self._here, context, budget_bps=budget_bps, shape=shape, named=self._spec.models)
            wide, high = shape.size or self._spec.size
            return {
                **figures(report, context),
                "set_fps": shape.fps,
                "base_width": wide,
                "base_height": high,
                "settings": used,
            }

        spec, words = self._spec, dict(self._found.classes.words)
        return self._known(
            self._key("flight", budget_bps, shape, spec.size, spec.budget_bps, spec.labels, words), fly
        )

    def _weight(self, budget_bps: int, shape: VideoShape) -> float:
        """The spending of a flight at this budget; without a ground, which cannot change it."""

        def dry_run(context: RunContext) -> RunRow:
            return {
                "bps": _or_refused(
                    lambda: dry_run_bps(self._here, context, budget_bps=budget_bps, shape=shape)
                )
            }

        return float(self._known(self._key("weight", budget_bps, shape), dry_run)["bps"])

    def _known(self, key: str, make: Callable[[RunContext], RunRow]) -> RunRow:
        """Out of the cache; else it is made, which alone needs pictures."""
        row = self._cache.get(key)
        if row is None:
            began_s = time.monotonic()
            row = self._made(make)
            row["wall_s"] = time.monotonic() - began_s
            self._cache.put(key, row)
        self.wall_s += row["wall_s"]
        return row

    def _made(self, make: Callable[[RunContext], RunRow]) -> RunRow:
        try:
            return make(self._context())
        except (UserError, _RefusedError, _BrokenError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001 - one bad flight of thousands must not end them all
            _log.exception("%s on %s ended in an error", self._spec.method, self._spec.sequence)
            said = str(error).strip().partition("\n")[0]
            raise _BrokenError(f"{type(error).__name__}: {said}".rstrip(": ")) from None

    def _context(self) -> RunContext:
        context = open_run_context(self._here, cache=self._folder)
        if context.content != self._found.content:  # the flight would be kept under the name of the old ones
            raise _BrokenError("files of the dataset or of a network were written meanwhile: run it again")
        return context

    def _key(self, what: str, budget_bps: int, shape: VideoShape, *more: Any) -> str:
        spec, found = self._spec, self._found
        flags = edge_flags(self._here, budget_bps=budget_bps, shape=shape, named=spec.models)
        frames = found.sequence.clip_frames
        said = (asdict(spec.models), spec.detect_every, found.content, found.software)
        return content_key(what, flags, frames, *said, *more)


def _or_refused(fly: Callable[[], _T]) -> _T:
    """A cache that cannot be written is no refusal: it ends the study."""
    try:
        return fly()
    except CacheError:
        raise
    except FlightError as error:  # in the middle of a flight the edge makes this of it
        if isinstance(error.__cause__, CacheError):
            raise error.__cause__ from None
        raise
    except UserError as error:
        raise _RefusedError(str(error)) from None


def _worth(row: RunRow) -> tuple[float, float]:
    """By this the best frame rate and size are chosen: named F1, then the boxes; of one target recall."""
    if row["named_f1"] is None:
        return row["recall"] or 0.0, row["top1_all"] or 0.0
    return row["named_f1"], row["f1"] or 0.0


def _matches(spec: RunSpec, row: RunRow) -> bool:
    return spec.target is None or within(row["total_bps"], spec.target.total_bps)


def _missed(spec: RunSpec, row: RunRow) -> str:
    assert spec.target is not None, "without a target nothing is missed"
    off_pct = 100 * (row["total_bps"] / spec.target.total_bps - 1)
    return f"spends {row['total_bps']} bps, {off_pct:+.1f} % off the {spec.target.total_bps} of {spec.target.method}"


def _identity(spec: RunSpec) -> RunRow:
    target = spec.target
    own = ("key", "dataset", "sequence", "labels", "method", "regime", "budget_bps", "still_codec")
    return {
        **{name: getattr(spec, name) for name in own},
        **{name: getattr(spec.models, name) for name in ("detector", "edge_detector", "classifier")},
        "accounting": "span",
        "matched_to": "" if target is None else target.method,
        "matched_codec": "" if target is None else target.still_codec,
        "target_bps": None if target is None else target.total_bps,
    }
