"""``hvt-study sight``: what do I see at this budget, on my clip, with each method?"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import write_json
from hvt_common.units import parse_size
from hvt_edge.source.opening import check_shape
from hvt_study.matrix.compare import ComparePlan, CompareResult, CompareRow, compare
from hvt_study.runs.compare_methods import METHODS, method_rows

__all__ = ["SUMMARY", "add_arguments", "print_result", "run"]

SUMMARY = "Fly every method at every rate over a clip and say what the ground sees."

_LEAST_KBPS, _MOST_KBPS = 20.0, 100_000.0
_LEAST_FRAMES = 30


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Clip, models, rates, methods, and where the results go."""
    parser.add_argument("clip", metavar="CLIP", help="a video, a folder of images, demo, or still:PICTURE")
    parser.add_argument(
        "--detector",
        required=True,
        default=argparse.SUPPRESS,
        metavar="FILE",
        help="of the ground and of the reference labels: FILE.onnx or a model's name",
    )
    parser.add_argument(
        "--edge-detector", default=argparse.SUPPRESS, metavar="FILE", help="of the edge (default: the same)"
    )
    parser.add_argument("--rates", default="150,200,300,400,800", metavar="KBPS,…", help="budgets in kbps")
    parser.add_argument("--methods", default=",".join(METHODS), metavar="NAME,…", help="which to fly")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        default=argparse.SUPPRESS,
        metavar="DIR",
        help="sight.json, sight.png",
    )
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="size of the base stream")
    parser.add_argument(
        "--max-frames", type=int, default=300, metavar="N", help="ticks of the clip, 15 a second"
    )
    parser.add_argument(
        "--jobs", type=int, default=argparse.SUPPRESS, metavar="N", help="processes (default: the cores)"
    )
    parser.add_argument(
        "--labels",
        default="auto",
        choices=("auto", "exact", "reference"),
        help="exact where the source knows them, or what the detector says of untouched frames",
    )
    parser.add_argument("--provider", default="auto", help="what runs the networks, as of hvt-edge")


def run(arguments: argparse.Namespace) -> int:
    """Fly, print the table, write it and the plot."""
    plan = _plan(arguments)
    folder: Path = arguments.out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder} cannot be made ({error.strerror}): name a folder") from None
    plot = _plotter()
    with _progress() as progress:
        tasks: dict[str, TaskID] = {}

        def on_step(what: str, done: int, of: int) -> None:
            if what not in tasks:
                tasks[what] = progress.add_task(what, total=of)
            progress.update(tasks[what], completed=done, total=of)

        result = compare(plan, on_step=on_step)
    if not result.rows:
        raise UserError(f"nothing could be flown: {result.missing[0].reason}")
    try:
        write_json(folder / "sight.json", [asdict(row) for row in result.rows])
        plot(result, folder / "sight.png")
    except OSError as error:
        raise UserError(f"--out {folder} cannot be written ({error.strerror}): name another") from None
    print_result(result)
    return 0


def print_result(result: CompareResult) -> None:
    """Both halves side by side, one line a method and rate."""
    console = Console(highlight=False)
    table = Table(
        title=f"{result.clip}, {result.labels} labels, first and second half",
        caption="all to tracks: kbps; kB: largest frame; p95: delay of frames, ms; CPU: of the edge, ms a tick",
        caption_justify="left",
        title_justify="left",
        title_style="bold",
        box=None,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for head, style in (("kbps", None), ("method", "cyan")):
        table.add_column(head, justify="left" if style else "right", style=style, no_wrap=True)
    for head in ("F1", "class", "all", "base", "stills", "tracks", "fps", "kB", "p95", "CPU"):
        table.add_column(head, justify="right", no_wrap=True)
    before = None
    for first, second in zip(result.rows[::2], result.rows[1::2], strict=True):
        if before not in (None, first.rate_kbps):
            table.add_section()
        before = first.rate_kbps
        table.add_row(f"{first.rate_kbps:g}", first.method, *_cells(first, second))
    console.print(table)
    for one in result.missing:
        console.print(f"{one.method} at {one.rate_kbps:g} kbps: not available, {one.reason}", markup=False)


def _cells(first: CompareRow, second: CompareRow) -> tuple[str, ...]:
    return (
        _pair(first.f1, second.f1),
        _pair(first.class_agreement, second.class_agreement),
        f"{first.total_bps / 1e3:.0f}",
        f"{first.base_bps / 1e3:.0f}",
        f"{first.roi_bps / 1e3:.0f}",
        f"{first.track_bps / 1e3:.1f}",
        f"{first.fps:.1f}",
        f"{first.max_frame_bytes / 1e3:.1f}",
        f"{first.delay_p95_ms:.0f}",
        f"{first.edge_cpu_ms:.0f}",
    )


def _pair(first: float, second: float) -> str:
    return f"{first:.3f} {second:.3f}".replace("0.", ".")


def _plan(arguments: argparse.Namespace) -> ComparePlan:
    size = parse_size(arguments.size, name="--size")
    check_shape(size=size, fps=15)
    jobs = getattr(arguments, "jobs", os.cpu_count() or 1)
    if not 1 <= jobs <= 256:
        raise UserError(f"--jobs {jobs} is not accepted: give a whole number from 1 to 256")
    if arguments.max_frames < _LEAST_FRAMES:
        raise UserError(f"--max-frames {arguments.max_frames} is too few: give {_LEAST_FRAMES} or more")
    return ComparePlan(
        clip=arguments.clip,
        detector=arguments.detector,
        edge_detector=getattr(arguments, "edge_detector", arguments.detector),
        rates_bps=_rates(arguments.rates),
        methods=method_rows(arguments.methods),
        size=size,
        max_frames=arguments.max_frames,
        jobs=jobs,
        labels=arguments.labels,
        provider=arguments.provider,
    )


def _rates(text: str) -> tuple[int, ...]:
    rates: set[int] = set()
    for word in text.split(","):
        try:
            kbps = float(word)
        except ValueError:
            kbps = math.nan
        if not _LEAST_KBPS <= kbps <= _MOST_KBPS:
            raise UserError(
                f"--rates {word.strip()!r} is not accepted: give kbps from {_LEAST_KBPS:g} to {_MOST_KBPS:g}, "
                "for example 150,200,300,400,800"
            )
        rates.add(round(kbps * 1000))
    return tuple(sorted(rates))


def _plotter() -> Callable[[CompareResult, Path], None]:
    """Matplotlib comes with ``hvt[study]``; the other commands do without it."""
    try:
        from hvt_study.report.figures.compare_plot import plot  # noqa: PLC0415
    except ImportError:
        raise UserError("the plot needs matplotlib: pip install 'hvt[study]'") from None
    return plot


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
    )
