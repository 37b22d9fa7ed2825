"""A flight from close by: stills beside source and base, and how it went, second by second."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hvt_study.report.data.document import Drawing, Picture, PictureRow, Pictures
from hvt_study.report.example.choice import CropExample, Example, Lane, Timeline, enlarged
from hvt_study.report.figures.drawing import GREY, INK, PALETTE, drawn, plain_axes

_LANE_IN = 0.18
_LEAST_PX = 360
"""Least longer side of a crop in files: 3 cm at 300 dots an inch."""


def crop_pictures(example: Example) -> Pictures:
    return Pictures(
        caption=(
            f"Crop comparison, {example.title}: {_which(example)} (luma, still less base, both against the source). "
            "The base is enlarged as the ground does, with exact alignment; pixels are shown as they are, as squares "
            "in the files."
        ),
        heads=("source", "base", "still"),
        rows=tuple(map(_row, example.crops)),
    )


def timeline_figure(example: Example, *, name: str) -> Drawing:
    """Rate, stills with their track, and seen objects, over time."""
    timeline = example.timeline

    def paint(figure: Figure) -> None:
        heights = (1.2, max(0.5, _LANE_IN * len(timeline.lanes)), 1.3)
        rate, lanes, seen = figure.subplots(3, 1, sharex=True, height_ratios=heights)
        _draw_rate(rate, timeline)
        _draw_lanes(lanes, timeline.lanes)
        _draw_seen(seen, timeline)
        seen.set_xlabel("time, s")
        seen.set_xlim(0, max(1, len(timeline.f1)))

    lanes_said = (
        f"{len(timeline.lanes)} of {timeline.tracks_named} named tracks, first those whose class changed most often, "
        "then those of which stills spoke most"
        if len(timeline.lanes) < timeline.tracks_named
        else "all tracks that stills named"
    )
    return drawn(
        name,
        paint,
        height_in=3.4 + max(0.5, _LANE_IN * len(timeline.lanes)),
        caption=(
            f"Timeline, {example.title}. Top: what was handed to the link in each second of the flight (whatever "
            "tables divide by), and B_tot; the last second may be a part of one, and has what was sent after the "
            f"last frame. Middle: {lanes_said}; a line where a track is listed, a filled diamond where a still "
            "changed its class (before > after), an open circle where it confirmed it. Bottom: F1 of the list, and "
            "the share of objects found and named, with and without the stills' word, mean of each second."
        ),
        alternative="Rate, stills and accuracy of one flight over time",
    )


def _row(crop: CropExample) -> PictureRow:
    change = (
        crop.class_after
        if crop.class_before == crop.class_after
        else f"{crop.class_before} > {crop.class_after}"
    )
    gain = f"{crop.gain_db:+.1f}".replace("-", "\N{MINUS SIGN}")
    label = (
        f"{crop.percentile}th percentile: {gain} dB over {crop.base_db:.1f} dB; {crop.size_bytes} bytes; "
        f"track {crop.track_id} at {crop.at_s:.1f} s, {change or 'not named'}"
    )
    parts = (("source", crop.source_png), ("base", crop.base_png), ("still", crop.still_png))
    return PictureRow(
        label,
        tuple(
            Picture(
                f"crop-{crop.percentile}-{name}",
                enlarged(png, least_px=_LEAST_PX),
                f"{name} of track {crop.track_id}",
            )
            for name, png in parts
        ),
    )


def _which(example: Example) -> str:
    """Which percentiles its stills show, as far as there are as many."""
    if example.stills == 1:
        return "its only still, with its gain in PSNR"
    shown = [f"{crop.percentile}th" for crop in example.crops]
    several = (
        f"{', '.join(shown[:-1])} and {shown[-1]} percentile" if len(shown) > 1 else f"{shown[0]} percentile"
    )
    return f"of its {example.stills} stills those at the {several} of the gain in PSNR"


def _draw_rate(axes: Axes, timeline: Timeline) -> None:
    seconds = np.arange(len(timeline.base_kbps) + 1)
    floor = np.zeros(len(timeline.base_kbps))
    parts = (
        ("base", timeline.base_kbps, PALETTE["sky"], ""),
        ("stills", timeline.roi_kbps, PALETTE["vermillion"], "////"),
        ("tracks and status", timeline.other_kbps, PALETTE["green"], ""),
    )
    for label, kbps, colour, hatch in parts:
        top = floor + np.asarray(kbps)
        axes.stairs(
            top,
            seconds,
            baseline=floor,
            fill=True,
            facecolor=colour,
            edgecolor="#ffffff",
            hatch=hatch,
            label=label,
            linewidth=0.4,
        )
        floor = top
    axes.axhline(timeline.budget_bps / 1e3, color=INK, linewidth=0.8, linestyle="--", label="B_tot")
    axes.set_ylabel("kbps")
    plain_axes(axes, grid="y")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=4, frameon=False, borderaxespad=0)


def _draw_lanes(axes: Axes, lanes: Sequence[Lane]) -> None:
    for row, lane in enumerate(lanes):
        for first, last in lane.spans_s:
            axes.plot([first, last], [row, row], color=GREY, linewidth=2.5, alpha=0.5, solid_capstyle="butt")
        for word in lane.words:
            changed = word.before != word.after
            axes.plot(
                [word.at_s],
                [row],
                color=PALETTE["vermillion"] if changed else PALETTE["blue"],
                marker="D" if changed else "o",
                fillstyle="full" if changed else "none",
                markersize=4,
                linestyle="none",
            )
            if changed:
                text = f"{word.before or 'unnamed'} > {word.after}"
                axes.annotate(
                    text, (word.at_s, row), (4, 2.5), textcoords="offset points", fontsize=6.5, color=INK
                )
    axes.set_yticks(range(len(lanes)), [f"track {lane.track_id}" for lane in lanes], fontsize=6.5)
    axes.set_ylim(max(len(lanes), 1) - 0.3, -0.9)
    plain_axes(axes, grid="x")


def _draw_seen(axes: Axes, timeline: Timeline) -> None:
    middle = np.arange(len(timeline.f1)) + 0.5
    curves = (
        ("F1 of the list", timeline.f1, INK, ":"),
        ("found & named", timeline.named, PALETTE["vermillion"], "-"),
        (
            "found & named, before",
            timeline.named_before,
            PALETTE["sky"],
            "--",
        ),  # last: seen where they are equal
    )
    for label, series, colour, dashes in curves:
        axes.plot(middle, series, color=colour, linestyle=dashes, label=label)
    axes.set_ylim(0, 1.02)
    axes.set_ylabel("share")
    plain_axes(axes, grid="y")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False, borderaxespad=0)
