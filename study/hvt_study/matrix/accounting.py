"""Rates of a study's rows by the processed span, or as the pilot's notebooks had them: by the length of the clip."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, get_args

from hvt_study.metrics.bits import Accounting

ACCOUNTINGS: tuple[Accounting, ...] = get_args(Accounting)
_RATES = (
    "total_bps",
    "base_bps",
    "roi_bps",
    "track_bps",
    "other_bps",
    "back_bps",
    "target_bps",
    "stills_per_min",
)
"""Columns that something is divided by time for. Frames a second are not among them: the pilot's were right."""


def in_accounting(rows: Iterable[Mapping[str, Any]], accounting: Accounting) -> list[dict[str, Any]]:
    """The same rows with their rates in this accounting, whichever they were in.

    All runs of a sequence are divided by the same time: what matched, matches. Rates of failed runs stay null;
    a rate that cannot be said in this accounting, as the times are not known, becomes null.
    """
    return [_restated(row, accounting) for row in rows]


def _restated(row: Mapping[str, Any], accounting: Accounting) -> dict[str, Any]:
    found = {**row, "accounting": accounting}
    span_s, clip_s = row["duration_s"], row["clip_s"]
    if row["accounting"] == accounting:
        return found
    if not span_s or not clip_s:
        return found | dict.fromkeys(_RATES)
    factor = span_s / clip_s if accounting == "pilot" else clip_s / span_s
    for name in _RATES:
        if row[name] is not None:
            found[name] = type(row[name])(round(factor * row[name], 6 if isinstance(row[name], float) else 0))
    return found
