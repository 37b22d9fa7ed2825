"""From a flight and its labels to the figures of a row."""

from __future__ import annotations

import math
from typing import Any

from hvt_common.protocol.channels import Channel
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.flights.flight import FlightReport
from hvt_study.metrics.bits import bit_split, still_counts
from hvt_study.metrics.classes import class_score
from hvt_study.metrics.detection import detection_score
from hvt_study.metrics.first_correct import first_correct
from hvt_study.metrics.judged import LabelledFrames
from hvt_study.metrics.observed import (
    arrivals,
    detected_frames,
    proxies,
    refined_frames,
    refined_objects,
    shown_times_s,
    still_delays_ms,
)
from hvt_study.metrics.tracking import continuity, tracking_score
from hvt_study.runs.run_context import RunContext

_DIGITS = 6
_RATES = ("total_bps", "base_bps", "roi_bps")
_SAYS_OF_ONE = {
    *("recall", "recall_half_1", "recall_half_2", "top1_before", "top1", "top1_half_1", "top1_half_2"),
    *("top1_all_before", "top1_all", "found_share", "gaps", "longest_gap_s", "id_switches"),
    *("first_correct_p50_s", "first_correct_p90_s", "first_correct_never"),
}
"""What labels of one target can say: of the rest of the list nobody knows whether it is right."""


_OF_A_LIST = ("named_f1", "false_per_frame", "recall", "precision", "f1")
_OPINIONS = {
    "confidence_base": "confidence_base",
    "confidence_refined": "confidence_still",
    "confidence_gain": "gain",
    "positive_rate": "positive_rate",
    "change_rate": "change_rate",
    "entropy_gain_nats": "entropy_gain_nats",
}


def figures(report: FlightReport, context: RunContext) -> dict[str, Any]:
    """Every metric column of `hvt_study.runs.spec.COLUMNS`; None where a run has none."""
    labelled = _labelled(report, context)
    if context.sequence.one_target:
        labelled = {name: value if name in _SAYS_OF_ONE else None for name, value in labelled.items()}
    found = {**_bits(report, context), **labelled, **_delays(report), **_proxies(report)}
    found |= {"digest": report.digest, "edge_cpu_ms": report.edge_cpu_ms}
    return {name: _plain(value) for name, value in found.items()}


def _bits(report: FlightReport, context: RunContext) -> dict[str, Any]:
    stills, refined = arrivals(report.lists), refined_objects(report.lists)
    counts = still_counts(stills, refined, seconds=report.duration_s)
    span = bit_split(report.line_bytes, seconds=report.duration_s)
    pilot = bit_split(report.line_bytes, seconds=context.sequence.duration_s)
    return {
        "duration_s": report.duration_s,
        "clip_s": context.sequence.duration_s,
        **{name: round(getattr(span, name)) for name in (*_RATES, "track_bps", "other_bps")},
        # Of a server its questions, which are a row of what crossed the line.
        "back_bps": round(
            8 * (report.back_bytes + report.line_bytes.get(Channel.CONTROL, 0)) / report.duration_s
        ),
        **{f"{name}_pilot": round(getattr(pilot, name)) for name in _RATES},
        "fps": report.messages.get("base", 0) / report.duration_s,
        "stills": counts.stills,
        "stills_per_min": counts.stills_per_min,
        "mean_still_bytes": counts.mean_bytes,
        "tracks_refined": counts.tracks_refined,
    }


def _labelled(report: FlightReport, context: RunContext) -> dict[str, Any]:
    words: dict[str, Any] = {"word": context.classes.word, "classes": context.classes.classes}
    if context.sequence.one_target:  # a box of any class finds it
        words["classes"] = None
    labelled = refined_frames(report.lists, context.labels)
    detection = detection_score(detected_frames(report.lists, context.labels), **words)
    after = class_score(labelled, **words)
    before = class_score(labelled, refined=False, **words)
    tracking = tracking_score(labelled, **words)
    held = continuity(labelled, **words)
    first = first_correct(labelled, fps=NOMINAL_FPS, shown_s=shown_times_s(report.lists), **words)
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
        **_halves(labelled, words),
        "macro_f1_before": before.macro_f1_found,
        "macro_f1": after.macro_f1_found,
        "macro_f1_all_before": before.macro_f1_all,
        "macro_f1_all": after.macro_f1_all,
        **{f"top1_{size}": one.top1_found for size, one in after.by_size.items()},
        **{f"top1_all_{size}": one.top1_all for size, one in after.by_size.items()},
        "mota": tracking.mota,
        "idf1": tracking.idf1,
        "hota": tracking.hota,
        "id_switches": tracking.switches if tracking.objects else None,
        "found_share": held.found_share,
        "gaps": held.gaps if held.objects else None,
        "longest_gap_s": held.longest_gap / NOMINAL_FPS if held.objects else None,
        "first_correct_p50_s": first.median_s,
        "first_correct_p90_s": first.p90_s,
        "first_correct_never": first.never / first.tracks if first.tracks else None,
    }


def _halves(labelled: LabelledFrames, words: dict[str, Any]) -> dict[str, float]:
    """Of the list in each half of the clip: what is tuned on one half must hold in the other."""
    middle = len(labelled) // 2
    found: dict[str, float] = {}
    for half, part in enumerate((labelled[:middle], labelled[middle:]), start=1):
        one = class_score(part, **words)
        found |= {f"{name}_half_{half}": getattr(one, name) for name in _OF_A_LIST}
        found[f"top1_half_{half}"] = one.counts.top1_found
    return found


def _delays(report: FlightReport) -> dict[str, Any]:
    still_p50_ms, still_p95_ms = still_delays_ms(arrivals(report.lists))
    return {
        "delay_p50_ms": report.link.delay_p50_ms,
        "delay_p95_ms": report.link.delay_p95_ms,
        "still_delay_p50_ms": still_p50_ms,
        "still_delay_p95_ms": still_p95_ms,
        "picture_age_p95_ms": report.picture_age_p95_ms,
        "worst_queue_bytes": report.link.worst_queue_bytes,
        "max_frame_bytes": report.max_frame_bytes,
    }


def _proxies(report: FlightReport) -> dict[str, Any]:
    said = proxies(refined_objects(report.lists))
    found: dict[str, Any] = {"proxy_pairs": said.every.pairs, "small_pairs": said.small.pairs}
    for prefix, one in (("", said.every), ("small_", said.small)):
        found |= {f"{prefix}{column}": getattr(one, field) for column, field in _OPINIONS.items()}
    return found


def _plain(value: Any) -> Any:
    """No NaN, no digits that nobody can repeat; a wait that never ended stays infinite, or means would flatter."""
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, _DIGITS)
    return value
