"""The training curve as a picture (SVG), from the log of a run."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure


def draw_curve(log: Path, out: Path, *, title: str, quality: str) -> None:
    """Draw loss (left axis) and what the checks measured (right axis, 0…1) over the steps of a log.

    Args:
        log: JSON lines of `hvt_train.learning.loop.train`.
        out: the SVG file.
        title: above the curve.
        quality: what the right axis shows.
    """
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    figure = Figure(figsize=(7.2, 3), layout="constrained")
    left = figure.subplots()
    right = left.twinx()
    for axes, name, label, style in ((left, "loss", "loss", "-"), (right, "validation", quality, ".-")):
        points = [(row["step"], row[name]) for row in rows if name in row]
        colour = "#3060b0" if axes is left else "#c04020"
        axes.plot(*zip(*points, strict=True), style, color=colour)
        axes.set_ylabel(label, color=colour)
        axes.set_ylim(0)
    right.set_ylim(0, 1)
    left.set_xlabel("steps")
    left.set_title(title)
    out.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context({"svg.hashsalt": title}):
        figure.savefig(out, format="svg", metadata={"Date": None})
