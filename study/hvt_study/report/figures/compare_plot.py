"""The rate-utility plot of a comparison: what is shown over the bits that were really spent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hvt_study.matrix.compare import COMPARED, CompareResult, CompareRow

# Okabe and Ito's palette, told apart by every kind of colour vision; markers and dashes tell the rest apart in grey.
STYLES = {
    "M0": ("#000000", "o", "--"),
    "M0-fps": ("#000000", "s", "-"),
    "M0-best": ("#009E73", "P", "-"),
    "R0": ("#56B4E9", "^", "-"),
    "M5-jpeg": ("#E69F00", "v", "--"),
    "M5-residual": ("#E69F00", "D", "-"),
    "tracks": ("#CC79A7", "<", "-"),
    "M6": ("#D55E00", "*", "-"),
    "auto": ("#009E73", "P", "-"),
}
_MEASURES = (("named_f1", "named F1 of the list"), ("false_per_frame", "false objects a frame"))
_ONE_TARGET = (("recall", "share of its time at which the target is found"), ("gaps", "gaps"))
_DPI = 200


def plot(result: CompareResult, path: Path) -> None:
    """Write a PNG: named F1 and false objects a frame of the whole clip over kbps in all, a line a method.

    Of one target: the share of its time at which it is found, and the gaps.
    """
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True)
    rows = [row for row in result.rows if row["half"] == 0]
    for axes, (measure, label) in zip(panels, _ONE_TARGET if result.one_target else _MEASURES, strict=True):
        _draw(axes, rows, measure=measure)
        axes.set_ylabel(label)
        axes.set_xlabel("kbps in all, every byte counted")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside right center", frameon=False)
    figure.suptitle(
        f"{result.clip}: the ground's list over the whole clip, {result.labels} labels",
        fontsize="medium",
    )
    figure.savefig(path, dpi=_DPI, metadata={"Software": None})


def _draw(axes: Axes, rows: Sequence[CompareRow], *, measure: str) -> None:
    axes.set_xscale("log")
    for name in COMPARED:
        points = sorted(
            (row["total_bps"] / 1e3, value)
            for row in rows
            if row["method"] == name and (value := row[measure]) is not None
        )
        if not points:
            continue
        colour, marker, dashes = STYLES[name]
        axes.plot(
            [x for x, _ in points],
            [y for _, y in points],
            color=colour,
            marker=marker,
            linestyle=dashes,
            markersize=10 if marker == "*" else 6,
            linewidth=1.6,
            label=name,
        )
    marks = sorted({row["rate_kbps"] for row in rows})
    axes.set_xticks(marks, [f"{mark:g}" for mark in marks])
    axes.minorticks_off()
    axes.grid(visible=True, color="#dddddd", linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
