"""The rate-utility plot of a comparison: what is shown over the bits that were really spent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hvt_study.matrix.compare import COMPARED, CompareResult, CompareRow
from hvt_study.report.figures.drawing import plain_axes, rate_axis, style_of

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
    for name in COMPARED:
        points = sorted(
            (row["total_bps"] / 1e3, value)
            for row in rows
            if row["method"] == name and (value := row[measure]) is not None
        )
        if not points:
            continue
        style = style_of(name)
        axes.plot(*zip(*points, strict=True), linestyle=style.dashes, label=name, **style.marks(1.4))
    rate_axis(axes, [row["rate_kbps"] for row in rows])
    plain_axes(axes)
