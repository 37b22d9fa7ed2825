"""What do I see at this budget on my clip? Every method at every rate over one clip, flown and scored.

Flights run in processes of their own, a few at a time; the clip, its labels and what detectors said of identical
pixels are worked out once. *Labels* are exact where the source knows what it shows (the demo, an annotated picture
under the virtual camera), else *reference* labels: what the ground's own detector says of the untouched frames,
resampled to the base size, from a confidence of 0.25.
"""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from operator import eq
from pathlib import Path
from typing import Literal

from hvt_common.errors import UserError
from hvt_common.inference.class_names import same_kind
from hvt_common.inference.detect import MOTION
from hvt_common.inference.store import resolve_model
from hvt_study.datasets.clip import NOMINAL_FPS, clip_name, share_clip
from hvt_study.flights.flight import FlightReport
from hvt_study.metrics.list_score import Listed, ListScore, score_lists
from hvt_study.runs.compare_methods import MethodRow
from hvt_study.runs.compare_worker import Job, Refused, RunContext, class_names, fly_job, label_job, prepare

__all__ = ["ComparePlan", "CompareResult", "CompareRow", "Missing", "compare"]

Labels = Literal["auto", "exact", "reference"]

_LABEL_CHUNK = 16


@dataclass(frozen=True, slots=True)
class ComparePlan:
    """What to compare."""

    clip: str
    """What ``--source`` takes, if it ends by itself, or ``still:PICTURE``."""
    detector: str
    """The ground's, and the reference's."""
    edge_detector: str
    rates_bps: tuple[int, ...]
    methods: tuple[MethodRow, ...]
    size: tuple[int, int] = (1280, 720)
    max_frames: int | None = None
    jobs: int = 2
    labels: Labels = "auto"
    provider: str = "auto"


@dataclass(frozen=True, slots=True)
class CompareRow:
    """One half of one flight. What is not of the list counts for the whole clip, in both halves alike."""

    clip: str
    rate_kbps: float
    method: str
    half: int
    """1 or 2."""
    f1: float
    """Of the ground's list at every tick, IoU 0.5, whatever the classes."""
    class_agreement: float
    """Share of the matched objects that are shown with their class."""
    total_bps: int
    base_bps: int
    roi_bps: int
    track_bps: int
    max_frame_bytes: int
    delay_p95_ms: float
    """Capture to arrival of base frames over a serial link of that rate."""
    edge_cpu_ms: float
    """CPU of the edge a tick."""
    labels: str
    """``exact`` or ``reference``."""
    fps: float
    """Frames a second that were sent, on average."""
    precision: float
    recall: float
    delay_p50_ms: float
    picture_age_p95_ms: float
    """Age of the newest picture at the ground, over all ticks."""
    worst_queue_bytes: int
    stills: int


@dataclass(frozen=True, slots=True)
class Missing:
    """A method that could not be flown at a rate."""

    rate_kbps: float
    method: str
    reason: str


@dataclass(frozen=True, slots=True)
class CompareResult:
    """All rows, by rate, then in the table's order of methods."""

    rows: tuple[CompareRow, ...]
    missing: tuple[Missing, ...]
    labels: str
    clip: str


def compare(
    plan: ComparePlan, *, on_step: Callable[[str, int, int], None] = lambda *_: None
) -> CompareResult:
    """Fly everything; ``on_step(what, done, of)`` is called as it goes on.

    Raises:
        UserError: the clip, a detector or a rate cannot be used.
    """
    for spec in {plan.detector, plan.edge_detector} - {MOTION}:
        resolve_model(spec, role="detector", words=(MOTION,))
    with tempfile.TemporaryDirectory(prefix="hvt-sight-") as folder, _pool(plan.jobs) as pool:
        on_step("clip", 0, 1)
        clip = share_clip(plan.clip, max_frames=plan.max_frames, folder=Path(folder))
        on_step("clip", 1, 1)
        shop = RunContext(
            clip=clip,
            cache=Path(folder),
            detector=plan.detector,
            edge_detector=plan.edge_detector,
            provider=plan.provider,
            size=plan.size,
        )
        truth, labels, same_class = _labels(plan, shop, pool, on_step)
        reports = _fly_all(plan, shop, pool, on_step)
    return _result(plan, clip_name(plan.clip), reports, _Judge(truth, labels, same_class))


@contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes: a fork would share threads and locks of what is open here. Nothing more is begun on errors."""
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=prepare)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


# Labels


def _labels(
    plan: ComparePlan, shop: RunContext, pool: ProcessPoolExecutor, on_step: Callable[[str, int, int], None]
) -> tuple[tuple[Listed, ...], str, Callable[[str, str], bool]]:
    """(what is there at every tick in source pixels, exact or reference, which class names agree)."""
    clip = shop.clip
    if plan.labels == "exact" and clip.truth is None:
        raise UserError(f"--labels exact: {plan.clip} does not say what it shows; leave --labels out")
    if clip.truth is not None and plan.labels != "reference":
        names = pool.submit(class_names, shop).result()
        same_words = set(clip.class_names) <= set(names)
        return clip.truth, "exact", eq if same_words else same_kind
    return _reference(shop, pool, on_step), "reference", eq


def _reference(
    shop: RunContext, pool: ProcessPoolExecutor, on_step: Callable[[str, int, int], None]
) -> tuple[Listed, ...]:
    starts = range(0, shop.clip.ticks, _LABEL_CHUNK)
    waiting = {pool.submit(label_job, shop, first, _LABEL_CHUNK): first for first in starts}
    found: dict[int, tuple[Listed, ...]] = {}
    for future in as_completed(waiting):
        found[waiting[future]] = future.result()
        on_step("reference labels", len(found), len(starts))
    return tuple(one for first in starts for one in found[first])


# Flights


def _fly_all(
    plan: ComparePlan, shop: RunContext, pool: ProcessPoolExecutor, on_step: Callable[[str, int, int], None]
) -> dict[Job, FlightReport | Refused]:
    """Every flight that is needed, each once."""
    jobs = dict.fromkeys(job for rate in plan.rates_bps for row in plan.methods for job in jobs_of(row, rate))
    # The long ones first, so that no process is left with one at the end.
    ordered = sorted(jobs, key=lambda job: ("M0" in job.flags, -(job.fps or NOMINAL_FPS)))
    waiting: dict[Future[FlightReport | Refused], Job] = {
        pool.submit(fly_job, shop, job): job for job in ordered
    }
    done: dict[Job, FlightReport | Refused] = {}
    on_step("flights", 0, len(jobs))
    for future in as_completed(waiting):
        done[waiting[future]] = future.result()
        on_step("flights", len(done), len(jobs))
    return done


def jobs_of(row: MethodRow, rate_bps: int) -> tuple[Job, ...]:
    """The flights that one method needs at one rate; fixed 15 frames a second is what M0 flies anyhow."""
    if not row.fps_choices:
        return (Job(rate_bps, row.flags),)
    return tuple(Job(rate_bps, row.flags, None if fps == NOMINAL_FPS else fps) for fps in row.fps_choices)


# Scores


@dataclass(frozen=True, slots=True)
class _Judge:
    truth: tuple[Listed, ...]
    labels: str
    same_class: Callable[[str, str], bool]

    def halves(self, report: FlightReport) -> tuple[ListScore, ListScore]:
        pairs = list(zip(self.truth, report.lists, strict=True))
        middle = len(pairs) // 2
        first, second = pairs[:middle], pairs[middle:]
        return score_lists(first, same_class=self.same_class), score_lists(second, same_class=self.same_class)

    def worth(self, report: FlightReport) -> float:
        """By this the best frame rate is chosen: objects found and named, over the whole clip."""
        first, second = self.halves(report)
        return (first + second).f1 * (first + second).class_agreement


def _result(
    plan: ComparePlan, clip: str, reports: dict[Job, FlightReport | Refused], judge: _Judge
) -> CompareResult:
    rows: list[CompareRow] = []
    missing: list[Missing] = []
    for rate in plan.rates_bps:
        digests: dict[str, str] = {}
        for row in plan.methods:
            flown = [reports[job] for job in jobs_of(row, rate)]
            good = [one for one in flown if isinstance(one, FlightReport)]
            if not good:
                reasons = [one.reason for one in flown if isinstance(one, Refused)]
                missing.append(Missing(rate / 1e3, row.name, reasons[0]))
                continue
            best = max(good, key=judge.worth)
            digests[row.name] = best.digest
            if digests.get(row.unlike) == best.digest:
                missing.append(
                    Missing(rate / 1e3, row.name, f"its settings change nothing over {row.unlike}")
                )
                continue
            rows += _rows(clip, rate, row.name, best, judge)
    return CompareResult(tuple(rows), tuple(missing), judge.labels, clip)


def _rows(clip: str, rate_bps: int, method: str, report: FlightReport, judge: _Judge) -> list[CompareRow]:
    return [
        CompareRow(
            clip=clip,
            rate_kbps=rate_bps / 1e3,
            method=method,
            half=half,
            f1=round(score.f1, 4),
            class_agreement=round(score.class_agreement, 4),
            total_bps=report.bps(),
            base_bps=report.bps("base"),
            roi_bps=report.bps("roi"),
            track_bps=report.bps("tracks"),
            max_frame_bytes=report.max_frame_bytes,
            delay_p95_ms=round(report.link.delay_p95_ms, 1),
            edge_cpu_ms=round(report.edge_cpu_ms, 1),
            labels=judge.labels,
            fps=round(report.messages.get("base", 0) / report.duration_s, 2),
            precision=round(score.precision, 4),
            recall=round(score.recall, 4),
            delay_p50_ms=round(report.link.delay_p50_ms, 1),
            picture_age_p95_ms=round(report.picture_age_p95_ms, 1),
            worst_queue_bytes=report.link.worst_queue_bytes,
            stills=report.messages.get("roi", 0),
        )
        for half, score in enumerate(judge.halves(report), start=1)
    ]
