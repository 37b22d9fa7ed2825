"""From a flight and its labels to the figures of a row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from hvt_common.protocol.channels import Channel
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.flights.flight import FlightReport
from hvt_study.metrics.bits import line_rates, still_counts
from hvt_study.metrics.classes import class_score
from hvt_study.metrics.detection import detection_score
from hvt_study.metrics.first_correct import first_correct
from hvt_study.metrics.judged import Judged, judged
from hvt_study.metrics.observed import (
    arrivals,
    detected_frames,
    proxies,
    refined_frames,
    refined_objects,
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


def figures(report: FlightReport, context: RunContext) -> dict[str, Any]:
    """Every metric column of `hvt_study.runs.spec.COLUMNS`; None where a run has none."""
    labelled = _labelled(report, context)
    if context.sequence.one_target:
        labelled = {name: value if name in _SAYS_OF_ONE else None for name, value in labelled.items()}
    found = {**_bits(report, context), **labelled, **_delays(report)}
    found |= {
        **proxies(refined_objects(report.lists)),
        "digest": report.digest,
        "edge_cpu_ms": report.edge_cpu_ms,
    }
    return {name: _plain(value) for name, value in found.items()}


def _bits(report: FlightReport, context: RunContext) -> dict[str, Any]:
    seconds, clip_s = report.duration_s, context.sequence.duration_s
    span, pilot = (line_rates(report.line_bytes, seconds=one) for one in (seconds, clip_s))
    # Of a server its questions, which are a row of what crossed the line.
    back_bytes = report.back_bytes + report.line_bytes.get(Channel.CONTROL, 0)
    return {
        "duration_s": seconds,
        "clip_s": clip_s,
        **{name: round(value) for name, value in span.items()},
        "back_bps": round(8 * back_bytes / seconds),
        **{f"{name}_pilot": round(pilot[name]) for name in _RATES},
        "fps": report.messages.get("base", 0) / seconds,
        **still_counts(arrivals(report.lists), refined_objects(report.lists), seconds=seconds),
    }


def _labelled(report: FlightReport, context: RunContext) -> dict[str, Any]:
    words: dict[str, Any] = {"word": context.classes.word, "classes": context.classes.classes}
    if context.sequence.one_target:  # a box of any class finds it
        words["classes"] = None
    frames = judged(refined_frames(report.lists, context.labels), **words)
    detection = detection_score(judged(detected_frames(report.lists, context.labels), **words))
    after, before = class_score(frames), class_score(frames, refined=False)
    tracking, held = tracking_score(frames), continuity(frames)
    first = first_correct(frames, fps=NOMINAL_FPS, shown_s=[one.shown_s for one in report.lists])
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
        **_halves(frames),
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


def _halves(frames: Sequence[Judged]) -> dict[str, float]:
    """Of the list in each half of the clip: what is tuned on one half must hold in the other."""
    middle = len(frames) // 2
    found: dict[str, float] = {}
    for half, part in enumerate((frames[:middle], frames[middle:]), start=1):
        one = class_score(part)
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


def _plain(value: Any) -> Any:
    """No NaN, no digits that nobody can repeat; a wait that never ended stays infinite, or means would flatter."""
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, _DIGITS)
    return value
