"""From rows to a report: the answer in a sentence, tables and figures in their order, words between."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

from hvt_study.metrics.bits import in_accounting
from hvt_study.report.data.arms import RunRow, Setting, clip_of, counts, sequence_of, settings
from hvt_study.report.data.captions import ENOUGH, METRICS, time_of, written
from hvt_study.report.data.document import Drawing, Part, Report, Section, Table
from hvt_study.report.data.pairs import Pair, equal_quality, pairs
from hvt_study.report.example.choice import Example
from hvt_study.report.figures.curve_figures import (
    codec_figure,
    difference_figures,
    equal_figures,
    utility_figure,
)
from hvt_study.report.figures.example_figures import crop_pictures, timeline_figure
from hvt_study.report.tables import (
    differences_table,
    equal_table,
    failed_table,
    matrix_table,
    metrics_table,
    named_table,
    pilot_table,
    proxy_table,
    seen_table,
    size_table,
    spent_table,
)
from hvt_study.runs.spec import table_of

DECIDES = "named_f1"
"""The figure by which methods are held against video."""
REFERENCES = ("M0", "M0-fps", "M0-best", "R0")


def answer(found: Sequence[Setting]) -> Iterator[str | Drawing]:
    """Against plain video at the same bits; of the first setting in a figure, too."""
    metric = METRICS[DECIDES]
    for setting in found:
        every = list(pairs(setting, references=("M0",)))
        plain = [pair for pair in every if pair.gaps(DECIDES)]
        if len(plain) < len(every):
            alone = ", ".join(f"{one.arm.name}, {one.arm.regime}" for one in every if one not in plain)
            yield (
                f"{setting.name}, labels: {setting.labels}. No {metric.title} of video at the same bits stands "
                f"beside {alone}: of these there is no answer."
            )
        if not plain:
            continue
        best = max(plain, key=lambda pair: pair.interval(DECIDES).mean)
        ahead = " ".join(filter(None, written(best.interval(DECIDES), metric, sign=True)))
        first = "The method furthest ahead of video at the same bits"
        if not best.interval(DECIDES).mean > 0:
            first = "No method is ahead of video at the same bits; the nearest"
        yield (
            f"{setting.name}, labels: {setting.labels}. {first} is {best.arm.name} in the {best.arm.regime} regime, "
            f"{ahead} {metric.title} "
            f"(n = {len(best.gaps(DECIDES))}). {_tally(plain)}"
        )
    for setting in found[:1]:
        yield from forests(setting, name="answer")


def forests(setting: Setting, *, name: str) -> Iterator[Drawing]:
    """Paired differences, a figure a regime."""
    yield from difference_figures(
        setting, list(pairs(setting, references=REFERENCES)), name=name, column=DECIDES
    )


def _tally(found: Sequence[Pair]) -> str:
    """Verdicts are of intervals, and intervals of enough sequences only."""
    intervals = [pair.interval(DECIDES) for pair in found]
    sure = [one for one in intervals if not math.isnan(one.low)]
    few = len(found) - len(sure)
    if not sure:
        return (
            f"That is no verdict: {_pairs(few, 'has', 'have')} fewer than {ENOUGH} independent sequences, of "
            "which an interval says nothing."
        )
    ahead, behind = sum(one.low > 0 for one in sure), sum(one.high < 0 for one in sure)
    left = f"; {few} more have fewer than {ENOUGH} independent sequences and are not counted" if few else ""
    return (
        f"Of {_pairs(len(sure), '', '')} the interval lies above 0 in {ahead}, below in {behind}, and holds 0 in "
        f"{len(sure) - ahead - behind}{left}. No account is taken of how many were looked at."
    )


def _pairs(count: int, one: str, several: str) -> str:
    return f"{count} pair{'' if count == 1 else 's'} of method and regime {one if count == 1 else several}".rstrip()


_MATRICES = ("named_f1", "map_50", "hota")


def make_report(
    rows: Sequence[RunRow], *, sweep: Table | None = None, example: Example | None = None
) -> Report:
    """All of it, in order; nothing is read or written. `UserError` where two different runs count at one place."""
    found = settings(rows)
    accounting = next((str(row["accounting"]) for row in rows), "span")
    sections = (
        Section("The answer", tuple(answer(found))),
        Section("Selector sweep", (sweep,) if sweep is not None else ()),
        Section("End-to-end results", tuple(_each(found, spent_table, seen_table, named_table, size_table))),
        Section("Method matrix", tuple(_matrices(found))),
        Section("Against video at the same bits", tuple(_against(found))),
        Section("Utility over bitrate", tuple(_curves(found, "utility", utility_figure))),
        Section("Still codecs", tuple(_curves(found, "codecs", codec_figure))),
        Section("One flight", tuple(_flight(rows, example))),
        Section("The pilot's accounting and proxies", tuple(_pilot(rows, found))),
        Section("Metrics", (metrics_table(accounting),)),
        Section("Runs that do not count", tuple(_there(failed_table(rows)))),
        Section("What it was run with", tuple(_provenance(rows))),
    )
    return Report(
        "Does the split beat the same bits spent on video?",
        tuple(_lead(rows)),
        tuple(section for section in sections if section.parts),
    )


def _lead(rows: Sequence[RunRow]) -> Iterator[str]:
    good = sum(map(counts, rows))
    clips, names = (len(set(map(name, rows))) for name in (clip_of, sequence_of))
    sequences = min(clips, names)
    span_s = sum(row["duration_s"] or 0 for row in rows if counts(row))
    bad = len(rows) - good
    strays = _strays(rows)
    accounting = next((row["accounting"] for row in rows), "span")
    yield (
        f"{_many(len(rows), 'run')} over {_many(sequences, 'sequence')}, {span_s / 60:.1f} minutes of flight. {good} "
        f"count; {bad or 'none'} failed or missed the total to be matched. Rates are of every byte that crosses the "
        f"line, over the {time_of(accounting)}, unless a table says otherwise."
    )
    if names > clips:
        yield f"Some have several names ({names} in all, for the very same pictures and labels), and count once."
    if strays:
        yield (
            f"{_many(strays, 'run')} of video {'was' if strays == 1 else 'were'} coded to the total of a run that is "
            "not the one in this table: no difference is taken from it."
        )
    yield (
        f"Means are over sequences, with 95 % percentile bootstrap intervals in brackets from {ENOUGH} sequences on: "
        "sequences are drawn, not frames, and those over one picture together. Of fewer than some ten the interval "
        "is too narrow. A dash stands where there is no figure."
    )


def _strays(rows: Sequence[RunRow]) -> int:
    """Followers that count and are in no pair, as in tables that were joined."""
    paired = {
        _flight_of(row)
        for setting in settings(rows)
        for pair in pairs(setting)
        for row in pair.matched.values()
    }
    matching = [row for row in rows if counts(row) and row["matched_to"]]
    return sum(_flight_of(row) not in paired for row in matching)


def _flight_of(row: RunRow) -> tuple[str, str, int]:
    return clip_of(row), row["digest"], row["target_bps"]


def _many(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _each(found: Iterable[Setting], *makers: Callable[[Setting], Table]) -> Iterator[Part]:
    tables = (make(setting) for setting in found for make in makers)
    yield from (table for table in tables if table.rows)


def _pilot(rows: Sequence[RunRow], found: Sequence[Setting]) -> Iterator[Part]:
    """Both accountings, whichever the other tables are in."""
    yield from _each(settings(in_accounting(rows, "span")), pilot_table)
    yield from _each(found, proxy_table)


def _matrices(found: Iterable[Setting]) -> Iterator[Part]:
    for setting in found:
        for column in _MATRICES:
            yield from _there(matrix_table(setting, column))


def _against(found: Sequence[Setting]) -> Iterator[Part]:
    for index, setting in enumerate(found):
        yield from _there(differences_table(setting, list(pairs(setting))))
        if index:  # the first stands above all
            yield from forests(setting, name=f"differences-{index + 1}")
        equal = [
            equal_quality(setting, arm, reference=reference, column=DECIDES)
            for regime in setting.regimes
            for arm in setting.hybrids(regime)
            for reference in REFERENCES
            if reference in setting.references()
        ]
        yield from equal_figures(setting, equal, name=f"equal-quality-{index + 1}", column=DECIDES)
        yield from _there(equal_table(setting, equal, column=DECIDES))


def _curves(found: Sequence[Setting], name: str, make: Callable[..., Drawing | None]) -> Iterator[Part]:
    for index, setting in enumerate(found, start=1):
        yield from _there(make(setting, name=f"{name}-{index}"))


def _flight(rows: Sequence[RunRow], example: Example | None) -> Iterator[Part]:
    """Only of a run that is in the table, and only if it is the very same flight."""
    digests = {row["key"]: row["digest"] for row in rows}
    if example is None or example.key not in digests:
        return
    if digests[example.key] != example.digest:
        yield f"{example.title}: flown again, it sent other payloads than the run in the table, and is not shown."
        return
    yield f"Which flight is shown is decided by rule: {example.rule}."
    yield timeline_figure(example, name="timeline")
    if example.crops:
        yield crop_pictures(example)


def _provenance(rows: Sequence[RunRow]) -> Iterator[Part]:
    said: dict[str, list[str]] = {}
    for row in rows:
        for name, version in table_of(row["versions"]).items():
            if version not in said.setdefault(name, []):
                said[name].append(version)
    if said:
        yield "Software: " + "; ".join(f"{name} {', '.join(each)}" for name, each in said.items()) + "."
    mixed = [name for name, each in said.items() if len(each) > 1]
    if mixed:
        yield f"Runs of different versions are mixed here: {', '.join(mixed)}."
    contents: dict[str, set[str]] = {}
    for row in rows:
        for role, digest in table_of(row["content"]).items():
            name = sequence_of(row) if role == "clip" else row.get(role, role)
            contents.setdefault(name, set()).add(str(digest))
    changed = [name for name, each in contents.items() if len(each) > 1]
    if changed:
        yield f"Files of one name and other content are mixed here: {', '.join(changed)}."
    yield (
        "Every row of results.parquet has the full configuration (config), the software (versions), hashes of the "
        "clip and the models (content) and of all payloads (digest), in the columns of these names."
    )


def _there(part: Part | None) -> Iterator[Part]:
    if part is not None:
        yield part
