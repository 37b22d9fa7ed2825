"""Which rows of a study are compared with which: conditions, settings, arms, and pairs at matched totals."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, TypeAlias
from urllib.parse import parse_qsl

from hvt_common.errors import UserError
from hvt_study.runs.methods import METHODS, Kind
from hvt_study.runs.spec import said_run, table_of
from hvt_study.runs.video_shape import SAME_TOTAL


@dataclass(frozen=True, slots=True, order=True)
class Conditions:
    """Conditions of a flight; the defaults are those of ``hvt-study run``."""

    size: tuple[int, int] = (1280, 720)
    """(width, height) of the base stream in pixels."""
    detect_every: int = 5
    max_frames: int = 0
    """0: the whole clip."""
    refine: str = "fuse"

    def unusual(self) -> Iterator[str]:
        if self.size != USUAL.size:
            yield f"base of {self.size[0]}x{self.size[1]}"
        if self.detect_every != USUAL.detect_every:
            every = "every frame" if self.detect_every == 1 else f"one frame in {self.detect_every}"
            yield f"detection on {every}"
        if self.max_frames != USUAL.max_frames:
            yield f"at most {self.max_frames} frames of each"
        if self.refine != USUAL.refine:
            yield f"--refine {self.refine}"


USUAL = Conditions()


def conditions_of(row: Mapping[str, Any]) -> Conditions:
    """Out of ``config``; missing ones are as usual."""
    return _said(row["config"])[0]


def tune_of(row: Mapping[str, Any]) -> tuple[str, ...]:
    """``KEY=VALUE`` of the method's parameters other than their defaults."""
    return _said(row["config"])[1]


def how_they_differ(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Where the configurations of two rows part, ``tune: none and a=1``; else their software, contents or totals."""
    for left, right in (
        (said_run(one), said_run(other)),
        *((table_of(one[column]), table_of(other[column])) for column in ("versions", "content")),
    ):
        ours, theirs = _flat(left), _flat(right)
        parts = [name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name)]
        if parts:
            return "; ".join(
                f"{name}: {_word(ours.get(name))} and {_word(theirs.get(name))}" for name in parts
            )
    return f"total_bps: {one['total_bps']} and {other['total_bps']}"


@lru_cache(maxsize=100_000)
def _said(config: str) -> tuple[Conditions, tuple[str, ...]]:
    run = said_run({"config": config})
    models = run.get("models")
    size = run.get("size") or USUAL.size
    conditions = Conditions(
        size=(int(size[0]), int(size[1])),
        detect_every=int(run.get("detect_every") or USUAL.detect_every),
        max_frames=int(run.get("max_frames") or USUAL.max_frames),
        refine=str((models.get("refine") if isinstance(models, Mapping) else None) or USUAL.refine),
    )
    return conditions, tuple(map(str, run.get("tune") or ()))


def _flat(content: Mapping[str, Any]) -> dict[str, Any]:
    """Without levels; the target is another run's, and has been compared."""
    found: dict[str, Any] = {}
    for name, value in content.items():
        found |= _flat(value) if isinstance(value, Mapping) and name != "target" else {name: value}
    found.pop("target", None)
    return found


def _word(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value)) or "none"
    return "none" if value in (None, "") else str(value)


RunRow: TypeAlias = Mapping[str, Any]
BySequence: TypeAlias = Mapping[str, RunRow]
"""One run of each sequence; the key is dataset and name."""
_WHOSE = ("regime", "method", "still_codec", "matched_to", "matched_codec")


@dataclass(frozen=True, slots=True, order=True)
class Models:
    """The networks that runs have in common."""

    detector: str
    edge_detector: str
    classifier: str

    def __str__(self) -> str:
        edge = "" if self.edge_detector == self.detector else f", at the edge {self.edge_detector}"
        reader = "the detector again" if self.classifier == "detector" else self.classifier
        return f"detector {self.detector}{edge}, stills read by {reader}"


@dataclass(frozen=True, slots=True)
class Arm:
    """A method in one regime, at its own budget: the unit of averages."""

    regime: str
    method: str
    still_codec: str

    @property
    def name(self) -> str:
        """Without the regime."""
        return f"{self.method} {self.still_codec}".strip()


@dataclass(frozen=True, slots=True)
class Setting:
    """Runs that may be averaged: same labels, same networks, same conditions, over one dataset or several.

    A sequence that is there under several names (``demo:0-4`` and ``demo:0-9``, the three copies of MOT17) is one.

    Raises `UserError` where two different runs count at one place, so that none of them is the one.
    """

    datasets: tuple[str, ...]
    labels: str
    models: Models
    rows: tuple[RunRow, ...]
    """All, those that count nowhere too."""
    conditions: Conditions = USUAL
    _counted: Mapping[tuple[str, ...], Mapping[str, tuple[RunRow, ...]]] = field(
        init=False, repr=False, compare=False
    )
    """By whose they are and by sequence; of followers one a target."""
    _names: Mapping[str, str] = field(init=False, repr=False, compare=False)
    """Names of sequences by `clip_of`: the first that each has in the table."""

    def __post_init__(self) -> None:
        names: dict[str, str] = {}
        for row in self.rows:
            names.setdefault(clip_of(row), sequence_of(row))
        object.__setattr__(self, "_names", names)
        counted: dict[tuple[str, ...], dict[str, tuple[RunRow, ...]]] = {}
        places: dict[tuple[Any, ...], RunRow] = {}
        for row in sorted(filter(counts, self.rows), key=self._name):
            whose, name = tuple(row[column] for column in _WHOSE), self._name(row)
            first = places.setdefault((whose, name, row["target_bps"]), row)
            if first is row:
                of = counted.setdefault(whose, {})
                of[name] = (*of.get(name, ()), row)
            elif first["key"] != row["key"] and sequence_of(first) == sequence_of(row):
                raise UserError(_conflict(first, row))
        _one_tune_a_method(self.rows)
        object.__setattr__(self, "_counted", counted)

    def _name(self, row: RunRow) -> str:
        return self._names[clip_of(row)]

    @property
    def name(self) -> str:
        """Name of the dataset, without the folders that lead to it."""
        return place(self.datasets[0]) if len(self.datasets) == 1 else f"all {len(self.datasets)} datasets"

    @property
    def sequences(self) -> int:
        """How many there are, whether or not their runs count."""
        return len(set(self._names.values()))

    @property
    def tunes(self) -> Mapping[str, tuple[str, ...]]:
        """Parameters of methods other than their defaults, by method."""
        return {row["method"]: said for row in self.rows if (said := tune_of(row))}

    @property
    def regimes(self) -> tuple[str, ...]:
        """From the thinnest."""
        budgets = {row["regime"]: row["budget_bps"] or 0 for row in self.rows}
        return tuple(sorted(budgets, key=lambda name: (budgets[name], name)))

    @property
    def accounting(self) -> str:
        return str(self.rows[0]["accounting"])

    def budget_bps(self, regime: str) -> int:
        return max(row["budget_bps"] or 0 for row in self.rows if row["regime"] == regime)

    def arms(self, regime: str) -> list[Arm]:
        """All in a regime, in the order of tables; also those of which no run counts."""
        found = {
            Arm(regime, row["method"], row["still_codec"])
            for row in self.rows
            if row["regime"] == regime and not row["matched_to"]
        }
        return sorted(found, key=lambda arm: (_order(arm.method), arm.still_codec))

    @property
    def all_arms(self) -> list[Arm]:
        return [arm for regime in self.regimes for arm in self.arms(regime)]

    @property
    def lines(self) -> list[tuple[str, str]]:
        """(method, still codec) of all arms, each once."""
        return list(dict.fromkeys((arm.method, arm.still_codec) for arm in self.all_arms))

    def hybrids(self, regime: str) -> list[Arm]:
        """Those whose totals video is matched with."""
        return [arm for arm in self.arms(regime) if not is_video(arm.method)]

    def references(self) -> list[str]:
        """Methods that were coded again to the totals of others, in the order of tables."""
        return sorted({row["method"] for row in self.rows if row["matched_to"]}, key=_order)

    def runs(self, arm: Arm) -> BySequence:
        found = self._counted.get((arm.regime, arm.method, arm.still_codec, "", ""), {})
        return {name: rows[0] for name, rows in found.items()}

    def matched(self, arm: Arm, reference: str) -> BySequence:
        """Runs of ``reference`` that were coded to the totals of the very runs of `runs`, within one per cent."""
        matching = self._counted.get((arm.regime, reference, "", arm.method, arm.still_codec), {})
        found = {name: _at_total(matching.get(name, ()), run) for name, run in self.runs(arm).items()}
        return {name: row for name, row in found.items() if row is not None}

    def video(self, reference: str) -> dict[str, list[RunRow]]:
        """All that count of a video-only method, by sequence, at whatever total."""
        found: dict[str, list[RunRow]] = {}
        for row in self.rows:
            if row["method"] == reference and counts(row):
                found.setdefault(self._name(row), []).append(row)
        return found


def counts(row: RunRow) -> bool:
    """Whether a run is in averages: it was flown, and its spending matches."""
    return not row["failed"] and bool(row["matched"])


def is_video(method: str) -> bool:
    return method in METHODS and METHODS[method].kind is Kind.VIDEO


def settings(rows: Sequence[RunRow]) -> list[Setting]:
    """The settings of a study: where several datasets share all else, all of them first, then each.

    Raises `UserError` where two different runs count at one place.
    """
    shared: dict[tuple[str, Models, Conditions], list[RunRow]] = {}
    for row in rows:
        models = Models(row["detector"], row["edge_detector"], row["classifier"])
        shared.setdefault((row["labels"], models, conditions_of(row)), []).append(row)
    found = []
    for (labels, models, conditions), own in shared.items():
        datasets = tuple(dict.fromkeys(row["dataset"] for row in own))
        if len(datasets) > 1:
            found.append(Setting(datasets, labels, models, tuple(own), conditions))
        for dataset in datasets:
            these = tuple(row for row in own if row["dataset"] == dataset)
            found.append(Setting((dataset,), labels, models, these, conditions))
    return found


def values(runs: Mapping[str, RunRow], column: str) -> dict[str, float]:
    """One figure of each run; NaN where it has none."""
    return {name: math.nan if row[column] is None else float(row[column]) for name, row in runs.items()}


def place(dataset: str) -> str:
    """``visdrone:/data/VisDrone2019-VID-val?fps=24`` as ``visdrone VisDrone2019-VID-val``."""
    scheme, _, rest = dataset.partition(":")
    where, _, _ = rest.partition("?")
    return f"{scheme} {where.rstrip('/').rpartition('/')[2]}".strip()


def sequence_of(row: RunRow) -> str:
    """Dataset and name."""
    return f"{row['dataset']}#{row['sequence']}"


def picture_of(name: str) -> str:
    """The picture of a sequence, by its `sequence_of`, whatever its options, seed or words of ``demo:``."""
    dataset, _, sequence = name.rpartition("#")
    place, _, options = dataset.partition("?")
    if place.startswith("demo:"):
        return "-".join(sequence.split("-")[:2])
    seeded = place.startswith("still:") and dict(parse_qsl(options)).get("seeds", "0") != "0"
    return f"{place}#{sequence.rpartition('-')[0] if seeded else sequence}"


def clip_of(row: RunRow) -> str:
    """Names pictures and labels by their content, under whatever name; by that where a row does not say it."""
    return _clip(row["content"]) or sequence_of(row)


@lru_cache(maxsize=100_000)
def _clip(content: str) -> str:
    return str(table_of(content).get("clip") or "")


def _order(method: str) -> tuple[int, str]:
    names = list(METHODS)
    return (names.index(method) if method in METHODS else len(names), method)


def _at_total(matching: Sequence[RunRow], run: RunRow) -> RunRow | None:
    """The follower whose target is this run's total: not that of another run of the same name."""
    total = run["total_bps"]
    known = [row for row in matching if row["target_bps"] is not None]
    nearest = min(known, key=lambda row: abs(row["target_bps"] - total), default=None)
    if nearest is None or abs(nearest["target_bps"] - total) > SAME_TOTAL * total:
        return None
    return nearest


def _conflict(one: RunRow, other: RunRow) -> str:
    name = f"{one['method']} {one['still_codec']}".strip()
    at = f" at the total of {one['matched_to']} {one['matched_codec']}".rstrip() if one["matched_to"] else ""
    return (
        f"two runs of {name}{at} on {one['sequence']}, {one['regime']} regime, count and are not the same "
        f"({how_they_differ(one, other)}): join studies that agree in this, or report each by itself"
    )


def _one_tune_a_method(rows: Sequence[RunRow]) -> None:
    first: dict[str, RunRow] = {}
    for row in filter(counts, rows):
        other = first.setdefault(row["method"], row)
        if tune_of(other) != tune_of(row):
            raise UserError(_mixed_tune(other, row))


def _mixed_tune(one: RunRow, other: RunRow) -> str:
    said = " and ".join(" ".join(tune_of(row)) or "its defaults" for row in (one, other))
    return (
        f"runs of {one['method']} with other parameters would be averaged together ({said}): join studies that agree "
        "in this, or report each by itself"
    )
