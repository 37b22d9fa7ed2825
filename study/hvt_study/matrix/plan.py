"""The runs of a study: first those that choose their own spending, then video at each of their totals.

Rows of an earlier start in the same folder stay unless this one has better ones. So a method, a budget or a sequence
may be added to ``--out``, and an interrupted study loses no finished run. One run never has two rows: the new one
replaces the old.

Does all runs of a study, some at a time, wherever a pool puts them; results come as they are ready.

A pool is anything with ``submit``: processes of this machine, or the workers of a Dask cluster. A finished run lies
in the cache; a study that was killed and is started again takes it from there.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hvt_common.errors import UserError
from hvt_common.units import parse_bitrate
from hvt_edge.profiles import REGIMES
from hvt_study.cache.results import content_key
from hvt_study.metrics.bits import in_accounting
from hvt_study.runs.methods import METHODS, Kind, Method
from hvt_study.runs.spec import ModelChoice, RunSpec, Target, said_run
from hvt_study.runs.video_shape import SAME_TOTAL, grid_target


@dataclass(frozen=True, slots=True)
class Regime:
    """A budget and its name."""

    name: str
    budget_bps: int


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """The methods, budgets, sequences and models of a study."""

    sequences: tuple[tuple[str, str], ...]
    """(URI of the dataset, name of the sequence)."""
    methods: tuple[Method, ...]
    regimes: tuple[Regime, ...]
    still_codecs: tuple[str, ...]
    models: tuple[ModelChoice, ...]
    labels: Literal["annotations", "reference"]
    cache: Path
    size: tuple[int, int] = (1280, 720)
    max_frames: int | None = None
    detect_every: int = 5
    tune: Mapping[str, tuple[str, ...]] | None = None
    matched_to: tuple[str, ...] | None = None
    """Methods at whose totals video is coded again; None: each that is not video itself."""

    def is_matched(self, spec: RunSpec) -> bool:
        """Whether video is coded again at the total of this run, if it does not fail."""
        if spec.target is not None or METHODS[spec.method].kind is Kind.VIDEO:
            return False
        return self.matched_to is None or spec.method in self.matched_to


def parse_regimes(text: str) -> tuple[Regime, ...]:
    """``low,moderate,300kbps`` as regimes, in that order.

    Raises `UserError` for a word that is neither the name of a regime nor a bitrate.
    """
    regimes: dict[str, Regime] = {}
    for word in (part.strip() for part in text.split(",")):
        if word in REGIMES:
            regimes[word] = Regime(word, REGIMES[word].budget_bps)
            continue
        try:
            regimes[word] = Regime(word, parse_bitrate(word, name="--regimes"))
        except UserError:
            raise UserError(
                f"--regimes {word!r} is not accepted: give {', '.join(REGIMES)} or a bitrate such as 300kbps"
            ) from None
    return tuple(regimes.values())


def first_runs(plan: StudyPlan) -> Iterator[RunSpec]:
    """Runs that need no other: hybrids and peers, and video at the whole budget."""
    for dataset, sequence in plan.sequences:
        for models in plan.models:
            for regime in plan.regimes:
                for method in plan.methods:
                    for codec in plan.still_codecs if method.sends_stills else ("",):
                        yield spec_of(plan, dataset, sequence, method, regime, models, codec)


def matched_runs(plan: StudyPlan, spec: RunSpec, row: Mapping[str, Any]) -> Iterator[RunSpec]:
    """Video at the total that this run really spent; nothing for a run that failed, or at whose total none is."""
    if not plan.is_matched(spec) or row["failed"] or not row["total_bps"]:
        return
    target = Target(spec.method, spec.still_codec, int(row["total_bps"]))
    for method in plan.methods:
        if method.kind is Kind.VIDEO:
            regime = Regime(spec.regime, spec.budget_bps)
            yield spec_of(plan, spec.dataset, spec.sequence, method, regime, spec.models, "", target)


def spec_of(
    plan: StudyPlan,
    dataset: str,
    sequence: str,
    method: Method,
    regime: Regime,
    models: ModelChoice,
    codec: str,
    target: Target | None = None,
) -> RunSpec:
    return RunSpec(
        dataset=dataset,
        sequence=sequence,
        method=method.name,
        regime=regime.name,
        budget_bps=regime.budget_bps,
        models=models,
        still_codec=codec,
        labels=plan.labels,
        size=plan.size,
        max_frames=plan.max_frames,
        detect_every=plan.detect_every,
        target=target,
        tune=(plan.tune or {}).get(method.name, ()),
    )


RunRow = dict[str, Any]
_CONDITIONS = ("dataset", "sequence", "regime", "budget_bps", "labels", "size", "max_frames", "detect_every")


def staying(done: Iterable[RunRow], earlier: Iterable[RunRow]) -> list[dict[str, Any]]:
    """Which earlier rows belong beside those that were done now, in their order, rates by the processed span.

    Not those of which there is a newer one, whatever its parameters and whatever ran its networks; and no video at
    the total of a run that spends something else by now.
    """
    done = list(done)
    replaced = {(_place(row), row["method"]) for row in done}
    totals = {_place(row): row["total_bps"] for row in done if not row["matched_to"]}
    return [
        row
        for row in in_accounting(earlier, "span")
        if (_place(row), row["method"]) not in replaced and _up_to_date(row, totals)
    ]


def check_parameters(plan: StudyPlan, earlier: Iterable[RunRow], *, out: Path) -> None:
    """`UserError` where a table holds runs of a method of this study with other parameters: no report takes both."""
    tunes = {method.name: list((plan.tune or {}).get(method.name, ())) for method in plan.methods}
    for row in earlier:
        known = said_run(row).get("tune")
        if row["failed"] or known is None or known == tunes.get(row["method"], known):
            continue
        said = " ".join(known) or "its defaults"
        raise UserError(
            f"--out {out} holds runs of {row['method']} with {said}, which go into no table with others: "
            "name another folder, or remove its results.parquet"
        )


def _up_to_date(row: RunRow, totals: Mapping[str, int | None]) -> bool:
    if not row["matched_to"] or _place(row) not in totals:
        return True
    total, target = totals[_place(row)], row["target_bps"]
    if not total or not target:
        return False
    return math.isclose(target, total, rel_tol=SAME_TOTAL)


def _place(row: RunRow) -> str:
    """Names a run that chooses its own spending, but for its budget: runs that match its total share the name."""
    run = said_run(row)
    if not run:
        return str(row["key"])
    whose = run.get("target") or run
    models = {name: value for name, value in (run.get("models") or {}).items() if name != "provider"}
    return content_key(
        whose.get("method"), whose.get("still_codec"), models, [run.get(name) for name in _CONDITIONS]
    )


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
    runs that follow from a finished one go before new ones, so that a sequence's pictures are used while they are
    warm.
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
    """The open runs. Of two runs that are one flight the second waits, and finds the result of the first."""

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
