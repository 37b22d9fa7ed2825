"""How figures look: for print, for every kind of colour vision, and legible in grey.

The rate-utility plot of a comparison: utility over the bits that were really spent.
"""

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hvt_study.matrix.compare import COMPARED, CompareResult, CompareRow
from hvt_study.report.data.arms import Arm
from hvt_study.report.data.document import Drawing

WIDTH_IN = 7.2
INK = "#000000"
"""Becomes the page's own colour of text in HTML."""
GREY = "#808080"
_MARK_IN = 0.36
"""A label of five digits, and a space."""

PALETTE: Mapping[str, str] = MappingProxyType(
    {
        "black": "#000000",
        "orange": "#E69F00",
        "sky": "#56B4E9",
        "green": "#009E73",
        "blue": "#0072B2",
        "vermillion": "#D55E00",
        "purple": "#CC79A7",
    }
)
"""Okabe and Ito 2008, without yellow, which paper hides."""

_RC: Mapping[str, Any] = MappingProxyType(
    {
        "font.family": ["DejaVu Sans"],
        "font.size": 8,
        "axes.titlesize": 8,
        "axes.labelsize": 8,
        "legend.fontsize": 7.5,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
        "axes.linewidth": 0.6,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "lines.linewidth": 1.3,
        "lines.markersize": 5,
        "pdf.fonttype": 42,
        "svg.fonttype": "none",
        "figure.facecolor": "none",
        "axes.facecolor": "none",
        "savefig.facecolor": "none",
    }
)


@dataclass(frozen=True, slots=True)
class Style:
    """Style of a method: any of the three tells it from its neighbours."""

    colour: str
    marker: str
    dashes: str

    def marks(self, size: float = 1.0) -> dict[str, Any]:
        """Colour and marker, as ``plot`` takes them; a star has little area."""
        area = 6.5 if self.marker == "*" else 4.5
        return {"color": self.colour, "marker": self.marker, "markersize": size * area}


_STYLES: Mapping[str, Style] = MappingProxyType(
    {
        "M0": Style(PALETTE["black"], "o", "--"),
        "M0-fps": Style(PALETTE["black"], "s", "-"),
        "M0-best": Style(PALETTE["green"], "P", "-"),
        "R0": Style(PALETTE["sky"], "^", "-"),
        "M1": Style(PALETTE["blue"], "o", ":"),
        "M2": Style(PALETTE["blue"], "v", "--"),
        "M3": Style(PALETTE["blue"], "D", "-."),
        "M4": Style(PALETTE["orange"], "^", ":"),
        "M5": Style(PALETTE["orange"], "D", "-"),
        "M5-jpeg": Style(PALETTE["orange"], "v", "--"),
        "M5-residual": Style(PALETTE["orange"], "D", "-"),
        "M6": Style(PALETTE["vermillion"], "*", "-"),
        "auto": Style(PALETTE["blue"], "X", "-"),
        # No triangle to the left or right: in figures of bits arrows say where a curve ends.
        "tracks": Style(PALETTE["purple"], "p", "-"),
        "permissive": Style(PALETTE["purple"], "s", ":"),
        "conf_size_top1": Style(PALETTE["purple"], "8", "--"),
        "strict_small_only": Style(PALETTE["purple"], "d", "-."),
        "balanced_top2": Style(PALETTE["purple"], "h", ":"),
        "DDS": Style(PALETTE["sky"], "H", "-."),
    }
)
_OTHER = Style(GREY, "x", "-")
_FILLS = ("full", "none", "left", "top", "right", "bottom")


def style_of(method: str) -> Style:
    """The same in every figure."""
    return _STYLES.get(method, _OTHER)


def fill_of(arm: Arm, codecs: tuple[str, ...]) -> Any:
    """How a marker is filled: by its codec, full for the first."""
    return _FILLS[codecs.index(arm.still_codec) % len(_FILLS)] if arm.still_codec in codecs else _FILLS[0]


def plain_axes(axes: Axes, *, grid: str = "both") -> None:
    """Two spines and a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, axis=grid, color=INK, alpha=0.22, linewidth=0.4)  # type: ignore[arg-type]
    axes.set_axisbelow(True)


def log_axis(axes: Axes, wanted: Iterable[float]) -> None:
    """A logarithmic axis, marked at those of these values that lie in it and have room, earlier ones first.

    Round ones fill the gaps: one mark alone tells no scale.
    """
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    apart = math.log(high / low) * _MARK_IN * axes.figure.dpi / axes.bbox.width
    marks: list[float] = []
    for value in (*wanted, *MaxNLocator(3).tick_values(low, high)):
        if low <= value <= high and all(abs(math.log(value / one)) >= apart for one in marks):
            marks.append(value)
    axes.set_xticks(marks, [f"{value:.0f}" if value >= 100 else f"{value:.3g}" for value in marks])
    axes.minorticks_off()


def rate_axis(axes: Axes, kbps: Sequence[float]) -> None:
    """One of bitrates, which holds all of these and marks them."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, *kbps), max(high, *kbps))
    log_axis(axes, sorted(set(kbps)))


def drawn(
    name: str,
    paint: Callable[[Figure], None],
    *,
    height_in: float,
    caption: str,
    alternative: str,
) -> Drawing:
    """Let ``paint`` fill a figure and write it as SVG and PDF; the same figure gives the same bytes."""
    own: Any = {**_RC, "svg.hashsalt": name}
    with mpl.rc_context(own):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        paint(figure)
        svg, pdf = io.BytesIO(), io.BytesIO()
        figure.savefig(pdf, format="pdf", metadata={"CreationDate": None})
        figure.savefig(svg, format="svg", metadata={"Date": None})
    return Drawing(name, caption, svg.getvalue().decode(), pdf.getvalue(), alternative)


_MEASURES = (("named_f1", "named F1 of the list"), ("false_per_frame", "false objects a frame"))
_ONE_TARGET = (("recall", "share of its time at which the target is found"), ("gaps", "gaps"))
_DPI = 200
_TITLE = 60
"""Letters of a clip's name for which there is room."""


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
    clip = result.clip if len(result.clip) <= _TITLE else f"…{result.clip[-_TITLE:]}"
    figure.suptitle(
        f"{clip}: the ground's list over the whole clip, {result.labels} labels",
        fontsize="medium",
        parse_math=False,
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
