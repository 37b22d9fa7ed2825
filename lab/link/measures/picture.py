"""One picture of all runs: the rates of link and sender over time, and below them the ages of arrivals."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lab.link.measures.outcome import Outcome, rate_over_time
from lab.link.measures.timing import Arrival

# Okabe and Ito: readable with any colour vision, and here also by line and marker.
_LINK, _BASE, _STILLS, _DARK = "#000000", "#0072B2", "#D55E00", "#BBBBBB"
_COLUMNS = 3
_LEGEND = {1: 3, 2: 5, 3: 5}
"""Names beside each other, by the picture's columns."""
_LATE_S = 1.0
_DELAYS_S = (0.02, 20.0)
_MOST_POINTS = 4000
_SAMPLES = 2000
"""Steps of the link's rate that are drawn: bursts of loss show in a minute, and a long run stays drawable."""


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Write the picture, PNG or whatever the suffix says."""
    columns = min(_COLUMNS, len(outcomes))
    rows = -(-len(outcomes) // columns)
    figure = Figure(figsize=(5.2 * columns + 0.6, 3.9 * rows + 0.5), layout="constrained")
    outer = figure.add_gridspec(rows, columns)
    for number, outcome in enumerate(outcomes):
        inner = outer[number // columns, number % columns].subgridspec(
            2, 1, height_ratios=[1, 1.1], hspace=0.04
        )
        above = figure.add_subplot(inner[0])
        below = figure.add_subplot(inner[1], sharex=above)
        _rates(above, outcome)
        _delays(below, outcome)
        for axes in (above, below):
            _shade(axes, outcome)
            axes.set_xlim(0, outcome.script.lasts_s)
            axes.spines[["top", "right"]].set_visible(False)
        above.tick_params(labelbottom=False)
        above.set_title(outcome.scenario, loc="left", fontsize=10, fontweight="bold")
        if number % columns == 0:
            above.set_ylabel("kbps")
            below.set_ylabel("delay, s")
        if number // columns == rows - 1:
            below.set_xlabel("s")
        if number == 0:
            handles = [*above.get_legend_handles_labels()[0], *below.get_legend_handles_labels()[0]]
            names = [*above.get_legend_handles_labels()[1], *below.get_legend_handles_labels()[1]]
    figure.legend(
        handles, names, loc="outside upper center", ncols=_LEGEND[columns], frameon=False, fontsize=9
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _rates(axes: Axes, outcome: Outcome) -> None:
    """The link's rate, and the bytes sent in each second, of all arrivals."""
    script, at_s = outcome.script, np.linspace(0, outcome.script.lasts_s, _SAMPLES)
    states = [script.at(float(t_s)) for t_s in at_s]
    capacity_kbps = [
        0.0 if one.dark or one.loss >= 1 else one.rate_bps * (1 - one.loss) / 1e3 for one in states
    ]
    axes.plot(at_s, capacity_kbps, color=_LINK, lw=1, drawstyle="steps-post", label="link carries")
    sent = rate_over_time(outcome, of=lambda one: one.send_s)
    stills = rate_over_time(outcome, of=lambda one: one.send_s, kinds=("roi", "backlog-still"))
    at_s = np.arange(len(sent) + 1)
    axes.stairs(np.array(sent) / 1e3, at_s, color=_BASE, lw=1.4, label="sent")
    axes.stairs(np.array(stills) / 1e3, at_s, color=_STILLS, lw=1, ls="--", label="of it stills")
    axes.set_ylim(0, 1.12 * max(phase.state.rate_bps for phase in script.phases) / 1e3)


def _delays(axes: Axes, outcome: Outcome) -> None:
    """From capture to arrival, of every frame and every still."""
    for arrivals, name, colour, marker, size in (
        (outcome.frames, "delay of a frame", _BASE, ".", 3),
        (outcome.stills, "delay of a still", _STILLS, "x", 3),
    ):
        some = _thinned(arrivals)
        axes.plot(
            [one.received_s - outcome.began_s for one in some],
            np.clip([one.delay_s for one in some], *_DELAYS_S),
            color=colour,
            ls="none",
            marker=marker,
            ms=size,
            mew=0.7,
            label=name,
        )
    axes.axhline(_LATE_S, color=_LINK, lw=0.6, ls=":")
    axes.set_yscale("log")
    axes.set_ylim(*_DELAYS_S)
    axes.set_yticks([0.1, 1, 10], ["0.1", "1", "10"])


def _shade(axes: Axes, outcome: Outcome) -> None:
    for begin_s, end_s in outcome.script.dark:
        axes.axvspan(begin_s, end_s, color=_DARK, lw=0, zorder=0)


def _thinned(arrivals: Sequence[Arrival]) -> Sequence[Arrival]:
    return arrivals[:: len(arrivals) // _MOST_POINTS + 1]
