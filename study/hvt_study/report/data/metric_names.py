"""What each figure of a row is called in tables, how it is written, and what it is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from hvt_study.metrics.bootstrap import Interval
from hvt_study.report.data.captions import time_of

__all__ = ["METRICS", "NOTHING", "Metric", "number", "written"]

NOTHING = "\N{EN DASH}"
"""Stands where a run has no such figure."""
_MINUS = "\N{MINUS SIGN}"

Style = Literal["share", "kbps", "count", "seconds", "ms", "bytes", "rate", "nats"]
Better = Literal["more", "less", ""]
_SCALE = {"kbps": 1e-3}
_DIGITS = {"share": 3, "kbps": 1, "count": 1, "seconds": 2, "ms": 0, "bytes": 0, "rate": 1, "nats": 3}


@dataclass(frozen=True, slots=True)
class Metric:
    """A column of ``results.parquet`` that tables show."""

    column: str
    name: str
    """In the head of a column."""
    style: Style
    says: str
    """The definition, a phrase; ``{time}`` stands for what rates are divided by."""
    group: str
    better: Better = "more"
    over: Literal["mean", "median"] = "mean"
    """What is taken over sequences: waits may be infinite, which a mean does not survive."""

    def definition(self, accounting: str) -> str:
        """In a table whose rates are of this accounting."""
        return self.says.replace("{time}", time_of(accounting))


def _metrics() -> tuple[Metric, ...]:
    return (*_bits(), *_detection(), *_classes(), *_tracks(), *_delays(), *_proxies())


def _bits() -> Iterator[Metric]:
    def rate(column: str, name: str, says: str) -> Metric:
        return Metric(column, name, "kbps", says, "Bits and stills", "")

    def count(column: str, name: str, style: Style, says: str) -> Metric:
        return Metric(column, name, style, says, "Bits and stills", "")

    yield rate("total_bps", "total, kbps", "line bytes of everything x 8 / {time}")
    yield rate("base_bps", "base, kbps", "base stream with headers and transport")
    yield rate("roi_bps", "stills / 2nd pass, kbps", "stills, or the second pass of DDS, likewise")
    yield rate("track_bps", "tracks, kbps", "the edge's own tracks")
    yield rate("other_bps", "other, kbps", "status, and what a server asks for; the four make the total")
    yield rate(
        "back_bps",
        "back, kbps",
        "from the ground to the edge: results, or questions of a server; the latter are in the total",
    )
    yield count("fps", "frames/s", "rate", "frames of the base stream a second")
    yield count("stills_per_min", "stills/min", "rate", "stills that arrived, a minute of the {time}")
    yield count("mean_still_bytes", "bytes/still", "bytes", "mean payload of a still")
    yield count("tracks_refined", "tracks refined", "count", "distinct tracks of the ground named by a still")
    yield rate("total_bps_pilot", "total, pilot", "the same bytes by the length of the whole clip")
    yield rate("base_bps_pilot", "base, pilot", "likewise")
    yield rate("roi_bps_pilot", "stills / 2nd pass, pilot", "likewise")


def _detection() -> Iterator[Metric]:
    def share(column: str, name: str, says: str) -> Metric:
        return Metric(column, name, "share", says, "Detection and list")

    at_50 = (
        "COCO mAP at IoU 0.5, detections on decoded base frames; those below the tracker's least confidence"
    )
    yield share("map_50", "mAP@.5", f"{at_50} (0.10) do not exist, which makes it lower than published ones")
    yield share("map_50_95", "mAP@.5:.95", "mean over IoU 0.50, 0.55 … 0.95, likewise")
    yield share("map_50_small", "mAP@.5 small", _SMALL)
    yield share("map_50_medium", "mAP@.5 medium", _MEDIUM)
    yield share("map_50_large", "mAP@.5 large", _LARGE)
    yield share("recall", "recall", "labels that the list has at IoU 0.5, whatever the class")
    yield share("precision", "precision", "boxes of the list that are on a label")
    yield share("f1", "F1", "of the list at every tick, whatever the class")


def _classes() -> Iterator[Metric]:
    def share(column: str, name: str, says: str, better: Better = "more") -> Metric:
        return Metric(column, name, "share", says, "Classes over time", better)

    def wait(column: str, name: str, says: str) -> Metric:
        return Metric(column, name, "seconds", says, "Classes over time", "less", over="median")

    yield share("top1_before", "top-1 before", "right class of those found, without stills")
    yield share("top1", "top-1", "right class of those found, every track at every tick")
    yield share("top1_all_before", "found & named before", "found & named without stills")
    yield share("top1_all", "found & named", "labels found and shown with their class, of all labels")
    yield share("macro_f1_before", "macro-F1 before", "macro-F1 without stills")
    yield share(
        "macro_f1", "macro-F1", "F1 over matched pairs, mean of the classes of labels that were found"
    )
    yield share("macro_f1_all_before", "macro-F1 of all, before", "macro-F1 of all without stills")
    yield share(
        "macro_f1_all",
        "macro-F1 of all",
        "F1 with missed labels and false boxes, mean of the classes of labels",
    )
    yield share("top1_small", "top-1 small", _SMALL)
    yield share("top1_medium", "top-1 medium", _MEDIUM)
    yield share("top1_large", "top-1 large", _LARGE)
    yield share("top1_all_small", "found & named small", _SMALL)
    yield share("top1_all_medium", "found & named medium", _MEDIUM)
    yield share("top1_all_large", "found & named large", _LARGE)
    yield wait(
        "first_correct_p50_s",
        "first right p50, s",
        "capture of a track's first tick to the arrival of the list that first names it right, median of tracks "
        "(Kaplan and Meier); median over sequences, the lower of two middle ones",
    )
    yield wait("first_correct_p90_s", "first right p90, s", "the same, nine tracks of ten")
    yield share("first_correct_never", "never right", "tracks that never get their right class", "less")


def _tracks() -> Iterator[Metric]:
    def share(column: str, name: str, says: str) -> Metric:
        return Metric(column, name, "share", says, "Tracks")

    yield share("mota", "MOTA", "1 - (misses + false + switches) / objects, IoU 0.5")
    yield share("idf1", "IDF1", "F1 of identities (Ristani et al. 2016)")
    yield share("hota", "HOTA", "√(DetA · AssA) over 19 IoUs (Luiten et al. 2021)")
    yield Metric("id_switches", "ID switches", "count", "changes of identity", "Tracks", "less")


def _delays() -> Iterator[Metric]:
    def wait(column: str, name: str, says: str, style: Style = "ms") -> Metric:
        return Metric(column, name, style, says, "Delay", "less")

    yield wait("delay_p50_ms", "base p50, ms", "capture to arrival over a serial link of B_tot")
    yield wait("delay_p95_ms", "base p95, ms", "the same, 95 of 100 frames")
    yield wait("still_delay_p50_ms", "still p50, ms", "from the capture of the still's frame")
    yield wait("still_delay_p95_ms", "still p95, ms", "the same, 95 of 100 stills")
    yield wait("edge_cpu_ms", "CPU, ms/tick", "CPU time of the edge a tick", "rate")


def _proxies() -> Iterator[Metric]:
    every = (
        ("", "", "objects in stills of which both opinions are there"),
        ("small_", " small", "those under 0.015 of the base frame"),
    )
    for kind, after, who in every:
        for column, name, style, says, better in _OPINIONS:
            own = column if kind or column != "pairs" else "proxy_pairs"
            yield Metric(f"{kind}{own}", f"{name}{after}", style, f"{says}; {who}", _PROXY, better)


_SMALL, _MEDIUM, _LARGE = "objects below 32² source pixels", "from 32² to 96²", "from 96² on"
_PROXY = "Proxies of the pilot (no labels)"
_OPINIONS: tuple[tuple[str, str, Style, str, Better], ...] = (
    ("confidence_base", "conf. base", "share", "mean confidence in the class seen in the base", "more"),
    ("confidence_refined", "conf. still", "share", "the same, seen in the still", "more"),
    ("confidence_gain", "gain", "share", "still - base, mean", "more"),
    ("positive_rate", "positive", "share", "share with a gain above 0", "more"),
    ("change_rate", "changed", "share", "share that gets another class", ""),
    ("entropy_gain_nats", "entropy gain, nats", "nats", "H(base) - H(still), mean", "more"),
    ("pairs", "pairs", "count", "how many", ""),
)

METRICS: Mapping[str, Metric] = MappingProxyType({metric.column: metric for metric in _metrics()})
"""By column, in the order of tables."""


def number(value: float, metric: Metric, *, sign: bool = False) -> str:
    """A figure in the unit of its metric; `NOTHING` for NaN. ``sign`` writes a plus, too."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞"
    text = f"{value * _SCALE.get(metric.style, 1):{'+' if sign else ''}.{_DIGITS[metric.style]}f}"
    if not any(digit in text for digit in "123456789"):  # neither -0.000 nor +0.000
        text = text.lstrip("+-")
    return text.replace("-", _MINUS)


def written(interval: Interval, metric: Metric, *, sign: bool = False) -> tuple[str, str]:
    """The mean, and its interval in brackets; the latter is empty where there is none."""
    mean = number(interval.mean, metric, sign=sign)
    if math.isnan(interval.low):
        return mean, ""
    return mean, f"[{number(interval.low, metric, sign=sign)}, {number(interval.high, metric, sign=sign)}]"
