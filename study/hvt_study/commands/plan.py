"""``hvt-study plan``: how many runs, bytes and hours a study would take."""

import argparse
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import print_table
from hvt_study.commands import arguments as common
from hvt_study.datasets.sequence import Sequence, staged_bytes
from hvt_study.matrix.plan import StudyPlan, first_runs
from hvt_study.runs.execute import run_spec
from hvt_study.runs.methods import METHODS, Kind, Method
from hvt_study.runs.run_context import open_run_context

_TRIAL_FRAMES = 30
_USUAL_WEIGHTS = 2.2
"""Times that video is coded without a ground until its total is right; measured on drone_carpark and the demo."""
_WEIGHT_SHARE = 0.5
"""The share of one of them in a flight."""
_ROW_BYTES = 9_000
_DETECTION_BYTES = 4_096
"""One file, of a block."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimate for a whole study."""

    sequences: int
    frames: int
    runs: int
    """Rows of results.parquet; where methods spend the same, several rows share one flight, and it takes less."""
    source_bytes: int
    cache_bytes: int
    scratch_bytes: int
    """Pixels of one sequence in the folder for temporary files, for each process."""
    cpu_s: float
    """On one core of this machine."""

    def hours(self, jobs: int) -> float:
        """With so many processes, each on a core of its own."""
        return self.cpu_s / jobs / 3600


def estimate(plan: StudyPlan, sequences: tuple[Sequence, ...], *, frame_s: float) -> Estimate:
    """Count what `hvt_study.matrix.plan.run_all` would do; ``frame_s`` is the time of a flight for a frame."""
    frames = sum(one.limited(plan.max_frames).clip_frames for one in sequences)
    video = [method for method in plan.methods if method.kind is Kind.VIDEO]
    first = list(first_runs(replace(plan, sequences=plan.sequences[:1])))  # of each sequence
    at_budget = sum(_flights(METHODS[one.method]) for one in first)
    at_totals = sum(map(plan.is_matched, first))
    matched = at_totals * sum(map(_flights, video))
    labelled = plan.labels == "reference"
    flights = at_budget + matched * (1 + _USUAL_WEIGHTS * _WEIGHT_SHARE) + labelled * len(plan.models)
    detections = (at_budget + matched) / plan.detect_every + labelled * len(plan.models)
    runs = len(sequences) * (len(first) + at_totals * len(video))
    return Estimate(
        sequences=len(sequences),
        frames=frames,
        runs=runs,
        source_bytes=sum(_size(path) for one in sequences for path in one.files),
        cache_bytes=runs * _ROW_BYTES + round(frames * detections * _DETECTION_BYTES),
        scratch_bytes=max(staged_bytes(one.limited(plan.max_frames).clip) for one in sequences),
        cpu_s=frames * flights * frame_s,
    )


def time_of_a_frame(plan: StudyPlan) -> float:
    """Fly the first hybrid of the plan (or the first method) for two seconds, and return the time of a frame.

    Raises `UserError` where the first sequence or a model cannot be used, or the edge does not take the settings.
    """
    specs = list(first_runs(replace(plan, sequences=plan.sequences[:1])))
    spec = next((one for one in specs if METHODS[one.method].kind is Kind.HYBRID), specs[0])
    spec = replace(spec, max_frames=_TRIAL_FRAMES)
    with TemporaryDirectory(prefix="hvt-study-") as folder:
        context = open_run_context(spec, cache=Path(folder))  # is done once for all runs over a sequence
        began_s = time.monotonic()
        row = run_spec(spec, cache=Path(folder))
        took_s = time.monotonic() - began_s
    if row["failed"]:
        raise UserError(f"{spec.method} at {spec.regime} cannot be flown: {row['failed']}")
    return took_s / context.sequence.clip_frames


def _flights(method: Method) -> int:
    """At most: of sizes two more at three rates each are usual (`hvt_study.runs.video_shape`)."""
    return max(1, len(method.fps_choices)) + (6 if method.any_size else 0)


def _size(path: Path) -> int:
    if path.is_dir():
        return sum(one.stat().st_size for one in path.iterdir() if one.is_file())
    return path.stat().st_size if path.is_file() else 0


_MANY_JOBS = 16


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of ``run``, so that one line can be both."""
    common.add_plan_arguments(parser, writes=False)
    common.option(parser, "--accounting", default="span")
    common.add_pool_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure a frame, count, print. Nothing is written."""
    jobs = [common.jobs_of(arguments)] if hasattr(arguments, "jobs") else [1, os.cpu_count() or 1, _MANY_JOBS]
    sequences = common.open_sequences(arguments)
    plan = common.study_plan(arguments, sequences)
    frame_s = time_of_a_frame(plan)
    found = estimate(plan, tuple(sequence for _, sequence in sequences), frame_s=frame_s)
    print_table("The study", _lines(found, frame_s=frame_s, jobs=tuple(dict.fromkeys(jobs))))
    return 0


def _lines(found: Estimate, *, frame_s: float, jobs: tuple[int, ...]) -> list[tuple[str, str]]:
    return [
        ("sequences", f"{found.sequences}"),
        ("frames, 15 a second", f"{found.frames}"),
        ("runs", f"{found.runs}"),
        ("pictures and annotations", _bytes(found.source_bytes)),
        ("cache, up to about", _bytes(found.cache_bytes)),
        ("temporary files of each process", _bytes(found.scratch_bytes)),
        ("one frame of a flight", f"{1e3 * frame_s:.0f} ms"),
        *(
            (f"hours with {many} process{'es' * (many > 1)}", hours_in_words(found.hours(many)))
            for many in jobs
        ),
    ]


def hours_in_words(hours: float) -> str:
    """A short time in a smaller unit: 0.0 hours say nothing."""
    if hours >= 1:
        return f"{hours:.1f}"
    seconds = 3600 * hours
    if seconds >= 1:
        short = f"{seconds / 60:.0f} minutes" if seconds >= 120 else f"{seconds:.0f} s"
    else:
        short = "less than 1 s"
    return f"{hours:.4f} ({short})"


def _bytes(count: float) -> str:
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"
