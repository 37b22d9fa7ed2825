"""Runs all that a study takes, some at a time, wherever a pool puts them; results come as they are ready.

A pool is anything with ``submit``: processes of this machine, or the workers of a Dask cluster. What is finished lies
in the cache; a study that was killed and is started again takes it from there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from typing import Any

from hvt_study.matrix.plan import StudyPlan, first_runs, matched_runs
from hvt_study.runs.methods import Kind
from hvt_study.runs.spec import RunSpec
from hvt_study.runs.video_shape import grid_target

RunRow = dict[str, Any]


def run_all(
    plan: StudyPlan,
    *,
    pool: Executor,
    run: Callable[[RunSpec], RunRow],
    at_once: int,
    on_row: Callable[[RunRow, int, int], None] = lambda *_: None,
) -> list[RunRow]:
    """Run everything; return the rows in the order of the plan (`in_order`).

    ``run(spec)`` is done in the pool. ``on_row(row, done, of)`` is called for each finished run; ``of`` sinks
    where a run has failed that others were to match. No more than ``at_once`` runs are handed to the pool at a time:
    what follows from a finished run goes before what has not begun, so that a sequence's pictures are looked at while
    they are warm.
    """
    agenda = _Agenda(plan)
    rows: list[RunRow] = []
    running: dict[Future[RunRow], RunSpec] = {}
    try:
        while agenda or running:
            for spec in agenda.take(at_once - len(running)):
                running[pool.submit(run, spec)] = spec
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                spec = running.pop(future)
                rows.append(row := future.result())
                agenda.finished(spec, row)
                on_row(row, len(rows), agenda.total)
    finally:
        for future in running:
            future.cancel()
    return in_order(plan, rows)


def in_order(plan: StudyPlan, rows: Iterable[RunRow]) -> list[RunRow]:
    """Rows of a study, finished or not, in the order of its plan: those that match a run's total behind that run."""
    pending = {row["key"]: row for row in rows}
    order: list[RunRow] = []
    for spec in first_runs(plan):
        first = pending.pop(spec.key, None)
        if first is None:
            continue
        matched = (pending.pop(one.key, None) for one in matched_runs(plan, spec, first))
        order += [first, *(row for row in matched if row is not None)]
    return order


class _Agenda:
    """What is to be done. Of two runs that are one flight the second waits, and finds the result of the first."""

    def __init__(self, plan: StudyPlan) -> None:
        self._plan = plan
        self._first: deque[RunSpec] = deque(first_runs(plan))
        self._matched: deque[RunSpec] = deque()
        self._busy: set[tuple[object, ...]] = set()
        self._video = sum(method.kind is Kind.VIDEO for method in plan.methods)
        self.total = sum(1 + self._expected(spec) for spec in self._first)

    def __bool__(self) -> bool:
        return bool(self._first or self._matched)

    def take(self, count: int) -> Iterator[RunSpec]:
        """Up to so many that may be begun now."""
        for queue in (self._matched, self._first):
            for spec in tuple(queue):
                if count <= 0:
                    return
                flight = _flight(spec)
                if flight in self._busy:
                    continue
                self._busy.add(flight)
                queue.remove(spec)
                count -= 1
                yield spec

    def finished(self, spec: RunSpec, row: RunRow) -> None:
        self._busy.discard(_flight(spec))
        matched = list(matched_runs(self._plan, spec, row))
        self._matched += matched
        self.total += len(matched) - self._expected(spec)

    def _expected(self, spec: RunSpec) -> int:
        """How many runs follow from one, if it does not fail."""
        return self._video if self._plan.is_matched(spec) else 0


def _flight(spec: RunSpec) -> tuple[object, ...]:
    near = None if spec.target is None else grid_target(spec.target.total_bps)
    return (spec.dataset, spec.sequence, spec.method, spec.budget_bps, spec.still_codec, spec.models, near)
