"""``hvt-study plan``: how many runs, bytes and hours a study would take."""

from __future__ import annotations

import argparse
import os

from hvt_common.runtime.reporting import print_table
from hvt_study.commands.arguments import (
    add_plan_arguments,
    add_pool_arguments,
    jobs_of,
    open_sequences,
    option,
    study_plan,
)
from hvt_study.matrix.estimate import Estimate, estimate, time_of_a_frame

_MANY_JOBS = 16


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of ``run``, so that one line can be both."""
    add_plan_arguments(parser, writes=False)
    option(parser, "--accounting", default="span")
    add_pool_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure a frame, count, print. Nothing is written."""
    jobs = [jobs_of(arguments)] if hasattr(arguments, "jobs") else [1, os.cpu_count() or 1, _MANY_JOBS]
    sequences = open_sequences(arguments)
    plan = study_plan(arguments, sequences)
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
    """What is short in a unit in which it is a number: 0.0 hours say nothing."""
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
