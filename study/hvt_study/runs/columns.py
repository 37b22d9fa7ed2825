"""One row a run: the columns of ``results.parquet``, in their order. Metrics that a run cannot have are null."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["COLUMNS", "Column"]

Type = Literal["text", "int", "real", "yes"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column, its type, and what it says."""

    name: str
    type: Type
    says: str


COLUMNS: tuple[Column, ...] = (
    # What was run
    Column("key", "text", "names the run's specification"),
    Column("dataset", "text", "URI"),
    Column("sequence", "text", "name within the dataset"),
    Column("labels", "text", "annotations or reference"),
    Column("method", "text", ""),
    Column("regime", "text", "low, moderate, or the budget in words"),
    Column("budget_bps", "int", "B_tot of the regime"),
    Column("still_codec", "text", "empty where the method sends no stills"),
    Column("detector", "text", "of the ground"),
    Column("edge_detector", "text", ""),
    Column("classifier", "text", ""),
    Column("matched_to", "text", "method whose total this run spends; empty for none"),
    Column("matched_codec", "text", "still codec of that run"),
    Column("target_bps", "int", "its total; null for none"),
    Column("matched", "yes", "the total is within 1 % of the target, or there is none"),
    Column("failed", "text", "why the run counts nowhere; empty for those that do"),
    # Bits a second
    Column("accounting", "text", "what rates are divided by: span, or the clip as the pilot did"),
    Column("duration_s", "real", "processed span"),
    Column("clip_s", "real", "length of the whole clip"),
    Column(
        "total_bps",
        "int",
        "everything from edge to ground, and what a server (DDS) asks; reports from the ground are not in it",
    ),
    Column("base_bps", "int", "base stream with its headers and transport"),
    Column("roi_bps", "int", "stills with theirs"),
    Column("track_bps", "int", "tracks of the edge"),
    Column("other_bps", "int", "status, and what a server asks"),
    Column(
        "back_bps",
        "int",
        "ground to edge: reports on stills, beside the total; a server's questions are in it",
    ),
    Column("total_bps_pilot", "int", "in the pilot's accounting, whatever the others are in"),
    Column("base_bps_pilot", "int", ""),
    Column("roi_bps_pilot", "int", ""),
    Column("fps", "real", "frames of the base stream a second"),
    Column("stills", "int", ""),
    Column("stills_per_min", "real", ""),
    Column("mean_still_bytes", "real", ""),
    Column("tracks_refined", "int", ""),
    Column(
        "first_correct_p50_s",
        "real",
        "capture of a track's first tick to its first right class shown, median",
    ),
    Column("first_correct_p90_s", "real", ""),
    Column("first_correct_never", "real", "share of tracks that are never shown right"),
    # Detection on base frames
    Column("map_50", "real", "mAP@0.5"),
    Column("map_50_95", "real", "mAP@[.5:.95]"),
    Column("map_50_small", "real", "objects below 32 x 32 source pixels"),
    Column("map_50_medium", "real", ""),
    Column("map_50_large", "real", ""),
    Column("recall", "real", "of the list at every tick, IoU 0.5, whatever the classes"),
    Column("precision", "real", ""),
    Column("f1", "real", ""),
    # Classes of tracks over time
    Column("top1_before", "real", "right class of those found, every track on every tick, before refinement"),
    Column("top1", "real", "after"),
    Column("top1_all_before", "real", "found with the right class, of all labels"),
    Column("top1_all", "real", ""),
    Column("macro_f1_before", "real", "over the classes of the labels that were found"),
    Column("macro_f1", "real", ""),
    Column("macro_f1_all_before", "real", "over all labels: a missed one is an error"),
    Column("macro_f1_all", "real", ""),
    Column("top1_small", "real", ""),
    Column("top1_medium", "real", ""),
    Column("top1_large", "real", ""),
    Column("top1_all_small", "real", "of all labels of that size"),
    Column("top1_all_medium", "real", ""),
    Column("top1_all_large", "real", ""),
    # Tracks
    Column("mota", "real", ""),
    Column("idf1", "real", ""),
    Column("hota", "real", ""),
    Column("id_switches", "int", ""),
    # Delay over a serial link of B_tot
    Column("delay_p50_ms", "real", "capture to arrival of base frames"),
    Column("delay_p95_ms", "real", ""),
    Column("still_delay_p50_ms", "real", "capture to arrival of stills"),
    Column("still_delay_p95_ms", "real", ""),
    Column("edge_cpu_ms", "real", "CPU of the edge a tick"),
    # The pilot's proxies
    Column("confidence_base", "real", "mean over refined objects, before"),
    Column("confidence_refined", "real", "mean, of the still"),
    Column("confidence_gain", "real", ""),
    Column("positive_rate", "real", "share of objects in stills whose confidence rises"),
    Column("change_rate", "real", "share of objects in stills whose class changes"),
    Column("entropy_gain_nats", "real", ""),
    Column("proxy_pairs", "int", "objects of which both opinions are there"),
    Column("small_confidence_base", "real", "the same for small objects"),
    Column("small_confidence_refined", "real", ""),
    Column("small_confidence_gain", "real", ""),
    Column("small_positive_rate", "real", ""),
    Column("small_change_rate", "real", ""),
    Column("small_entropy_gain_nats", "real", ""),
    Column("small_pairs", "int", ""),
    # What it was run with
    Column("config", "text", "the full configuration, JSON"),
    Column("versions", "text", "of software, JSON"),
    Column("content", "text", "hashes of clip and models, JSON"),
    Column("digest", "text", "of all payloads"),
    Column("wall_s", "real", "time that it took"),
)
"""The table of a study."""
