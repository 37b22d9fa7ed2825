"""What to fly, of a comparison: the simplest method that nothing beats by more than noise, and its very command."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from types import MappingProxyType

from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.datasets.virtual_camera import SCHEME
from hvt_study.matrix.compare import ComparePlan, CompareResult, CompareRow

NOISE = 0.01
"""Two figures that differ by less are alike."""
SIMPLEST_FIRST: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "M0": ("--method", "M0"),
        "M0-fps": ("--method", "M0"),
        "M0-best": ("--method", "M0"),
        "R0": ("--method", "R0"),
        "tracks": ("--profile", "tracks"),
        "M5-jpeg": ("--profile", "M5-jpeg"),
        "M5-residual": ("--profile", "M5-residual"),
        "auto": ("--profile", "auto"),
        "M6": ("--profile", "thin"),
    }
)
"""Names of `COMPARED`, from the one with the fewest parts on, with what ``hvt-edge`` calls them."""
_STALE_MS = 500


@dataclass(frozen=True, slots=True)
class Verdict:
    """Of one budget."""

    sentence: str
    command: str
    """Empty where nothing is worth flying."""


def verdicts(plan: ComparePlan, result: CompareResult) -> tuple[Verdict, ...]:
    """One a budget, in order; judged by named F1 of the whole clip, or by recall where one target is labelled."""
    wholes = (whole for whole, _, _ in result.flights)
    by_rate = groupby(wholes, key=lambda row: row["rate_kbps"])
    return tuple(_verdict(plan, rate, {row["method"]: row for row in rows}) for rate, rows in by_rate)


def command_of(plan: ComparePlan, row: CompareRow) -> str:
    """The edge's command line for a flight of the comparison; for a picture the camera is to be filled in."""
    width, height = row["base_width"], row["base_height"]
    words = ["hvt-edge", "--source", *_source(plan), "--budget", f"{row['rate_kbps']:g}kbps"]
    words += ["--size", f"{width}x{height}", *SIMPLEST_FIRST[row["method"]]]
    fps = row["set_fps"]
    if fps is not None and fps != NOMINAL_FPS:
        words += ["--fps", f"{fps:g}"]
        if fps < 2:  # the budget's window has to hold two frames
            words += ["--window", f"{2 / fps:g}s"]
    if plan.models.edge_detector != EMBEDDED_DETECTOR:
        words += ["--detector", plan.models.edge_detector]
    return shlex.join(words)


def _source(plan: ComparePlan) -> tuple[str, ...]:
    if plan.clip.startswith(SCHEME):
        return ("CAMERA",)
    pictures = Path(plan.clip) / "img1"
    return (str(pictures),) if pictures.is_dir() else (plan.clip,)


def _verdict(plan: ComparePlan, rate_kbps: float, rows: Mapping[str, CompareRow]) -> Verdict:
    measure, name = next(
        (
            (measure, name)
            for measure, name in (("named_f1", "named F1"), ("recall", "recall"))
            if any(row[measure] is not None for row in rows.values())
        ),
        ("named_f1", "named F1"),
    )
    worth = {method: row[measure] or 0.0 for method, row in rows.items()}
    most = max(worth.values())
    begins = f"At {rate_kbps:g} kbps"
    if not most:
        return Verdict(f"{begins} no method shows anything right ({name} .000).", "")
    chosen = next(method for method in SIMPLEST_FIRST if method in worth and most - worth[method] < NOISE)
    row = rows[chosen]
    said = f"{begins} fly {_named(row)}: {name} {_share(worth[chosen])}"
    others = {method: value for method, value in worth.items() if method != chosen}
    if others:
        said += _against(chosen, worth[chosen], others)
    age_ms = row["picture_age_p95_ms"] or 0
    if age_ms > _STALE_MS:
        said += f" Its newest picture is up to {age_ms / 1e3:.1f} s old."
    return Verdict(said, command_of(plan, row))


def _against(chosen: str, value: float, others: Mapping[str, float]) -> str:
    other = max(others, key=lambda method: others[method])
    gap = value - others[other]
    if gap >= NOISE:
        return f", {_share(gap)} more than the next, {other}."
    alike = [method for method, found in others.items() if abs(value - found) < NOISE]
    return (
        f". {', '.join(alike)} within {_share(NOISE)[:3]}, which is no difference: {chosen} is the simplest."
    )


def _named(row: CompareRow) -> str:
    """The method, and what of it was chosen."""
    method, fps = str(row["method"]), row["set_fps"]
    size = f"{row['base_width']}x{row['base_height']} and " if method == "M0-best" else ""
    return method if fps is None else f"{method} at {size}{fps:g} frames a second"


def _share(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")
