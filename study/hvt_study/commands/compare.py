"""``hvt-study compare``: what does the ground show at this budget, on my clip, with each method?"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import write_json
from hvt_common.units import parse_size
from hvt_edge.source.contract import check_shape
from hvt_study.commands.arguments import add_pool_arguments, open_pool
from hvt_study.commands.progress import RunProgress
from hvt_study.matrix.compare import COMPARED, ComparePlan, CompareResult, CompareRow, compare
from hvt_study.report.figures.compare_plot import plot
from hvt_study.runs.methods import chosen_names
from hvt_study.runs.spec import ModelChoice

__all__ = ["add_arguments", "print_result", "run"]


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
    parser.add_argument("--methods", default=",".join(COMPARED), metavar="NAME,…", help="which to fly")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        default=argparse.SUPPRESS,
        metavar="DIR",
        help="compare.json, compare.png, and cache, where finished flights lie",
    )
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="size of the base stream")
    parser.add_argument(
        "--max-frames", type=int, default=300, metavar="N", help="frames of the clip, 15 a second"
    )
    add_pool_arguments(parser)
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
    pool, _ = open_pool(arguments)
    with RunProgress("runs") as progress, pool as workers:
        result = compare(plan, pool=workers, on_run=progress.update)
    if not result.rows:
        raise UserError(f"nothing could be flown: {result.missing[0].reason}")
    try:
        write_json(folder / "compare.json", list(result.rows))
        plot(result, folder / "compare.png")
    except OSError as error:
        raise UserError(f"--out {folder} cannot be written ({error.strerror}): name another") from None
    print_result(result)
    return 0


def print_result(result: CompareResult) -> None:
    """Both halves side by side, one line a method and rate."""
    console = Console(highlight=False)
    table = Table(
        title=f"{result.clip}, {result.labels} labels, first and second half",
        caption="all to tracks: kbps; kB: largest frame; p95: delay of frames, ms; CPU: of the edge, ms a frame",
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
        if before not in (None, first["rate_kbps"]):
            table.add_section()
        before = first["rate_kbps"]
        table.add_row(f"{first['rate_kbps']:g}", first["method"], *_cells(first, second))
    console.print(table)
    for one in result.missing:
        console.print(f"{one.method} at {one.rate_kbps:g} kbps: not available, {one.reason}", markup=False)


def _cells(first: CompareRow, second: CompareRow) -> tuple[str, ...]:
    return (
        f"{_share(first['f1'])} {_share(second['f1'])}",
        f"{_share(first['class_agreement'])} {_share(second['class_agreement'])}",
        f"{first['total_bps'] / 1e3:.0f}",
        f"{first['base_bps'] / 1e3:.0f}",
        f"{first['roi_bps'] / 1e3:.0f}",
        f"{first['track_bps'] / 1e3:.1f}",
        f"{first['fps']:.1f}",
        f"{first['max_frame_bytes'] / 1e3:.1f}",
        f"{first['delay_p95_ms']:.0f}",
        f"{first['edge_cpu_ms']:.0f}",
    )


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}".replace("0.", ".")


def _plan(arguments: argparse.Namespace) -> ComparePlan:
    size = parse_size(arguments.size, name="--size")
    check_shape(size=size, fps=15)
    if arguments.max_frames < _LEAST_FRAMES:
        raise UserError(f"--max-frames {arguments.max_frames} is too few: give {_LEAST_FRAMES} or more")
    return ComparePlan(
        clip=arguments.clip,
        models=ModelChoice(
            detector=arguments.detector,
            edge_detector=getattr(arguments, "edge_detector", arguments.detector),
            provider=arguments.provider,
        ),
        rates_bps=_rates(arguments.rates),
        cache=(arguments.out / "cache").absolute(),
        methods=chosen_names(arguments.methods, COMPARED),
        size=size,
        max_frames=arguments.max_frames,
        labels=arguments.labels,
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
