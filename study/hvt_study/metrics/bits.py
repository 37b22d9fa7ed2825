"""Bits and stills: the spending of a run.

Sizes are line bytes (payload, metadata and transport) as the ledger counts them. They are divided by the processed
span. The pilot's notebooks divided the bytes of the 300 frames that they processed by the length of the whole clip;
the accounting ``pilot`` does the same, for comparison with its printed table and for nothing else.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeAlias, get_args

from hvt_common.protocol.channels import Channel
from hvt_study.datasets.labels import NO_ID
from hvt_study.metrics.observed import RefinedObject, StillArrival

Accounting: TypeAlias = Literal["span", "pilot"]


def line_rates(row_bytes: Mapping[str, int], *, seconds: float) -> dict[str, float]:
    """Line bits a second by row of the key table, of ``FlightReport.line_bytes``: ``total_bps`` and its parts.

    ``track_bps`` is of the edge's own tracks, ``other_bps`` of status, requests and whatever else crossed the line.
    ``seconds`` go from the first processed frame to the end of the last, or, as the pilot's, over the whole clip.
    """
    _check(seconds)
    named = {Channel.BASE: "base_bps", Channel.ROI: "roi_bps", Channel.TRACKS: "track_bps"}
    rates = {name: 8 * row_bytes.get(row, 0) / seconds for row, name in named.items()}
    rates["other_bps"] = sum(8 * size / seconds for row, size in row_bytes.items() if row not in named)
    return {"total_bps": sum(rates.values()), **rates}


def still_counts(
    stills: Sequence[StillArrival], refined: Sequence[RefinedObject], *, seconds: float
) -> dict[str, float]:
    """Count arrived stills, and the distinct tracks of the ground on whose class a still has spoken.

    ``seconds`` are as in `line_rates`; the mean size, of payloads, is NaN where there is none.
    """
    _check(seconds)
    sizes = [one.size_bytes for one in stills]
    return {
        "stills": len(sizes),
        "stills_per_min": 60 * len(sizes) / seconds,
        "mean_still_bytes": sum(sizes) / len(sizes) if sizes else math.nan,
        "tracks_refined": len({one.track_id for one in refined} - {NO_ID}),
    }


def _check(seconds: float) -> None:
    if not seconds > 0:
        raise ValueError(f"rates are divided by {seconds} s, must be above 0")


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

    All runs of a sequence are divided by the same time: equal rates stay equal. Rates of failed runs stay null;
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
