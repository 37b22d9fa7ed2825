"""``hvt-study read``: which codes on roofs can be read at the ground, and how soon, for the same bits?"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hvt_common.errors import UserError
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.runtime.reporting import write_json
from hvt_common.units import parse_size
from hvt_edge.source.contract import check_shape
from hvt_study.commands.arguments import make_out, parse_rates
from hvt_study.commands.progress import RunProgress
from hvt_study.reading.compared import READ_METHODS, ReadPlan, ReadResult, ReadRow, compare_codes
from hvt_study.reading.score import ChannelScore
from hvt_study.reading.sheet import write_sheet
from hvt_study.runs.methods import chosen_names
from hvt_study.runs.spec import ModelChoice

_LEAST_FRAMES = 30
_WIDTH = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Scenes, models, rates, methods, and where the results go."""
    parser.add_argument(
        "dataset", metavar="DEMO", help="drawn scenes with codes: demo:codes, demo:0-4,codes, demo:codes,4k"
    )
    parser.add_argument(
        "--detector",
        default=EMBEDDED_DETECTOR,
        metavar="FILE",
        help="of edge and ground, which decides what gets a still: FILE.onnx or a model's name",
    )
    parser.add_argument("--rates", default="150,300", metavar="KBPS,…", help="budgets in kbps")
    parser.add_argument("--methods", default=",".join(READ_METHODS), metavar="NAME,…", help="which to fly")
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="size of the base stream")
    parser.add_argument(
        "--max-frames", type=int, default=150, metavar="N", help="frames of a scene, 15 a second"
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        default=argparse.SUPPRESS,
        metavar="DIR",
        help="read.json, read.png, and cache, where finished flights lie",
    )
    parser.add_argument("--provider", default="cpu", help="what runs the detector, as of hvt-edge")


def run(arguments: argparse.Namespace) -> int:
    """Fly, read, print the table, write it and a sheet of examples."""
    plan = _plan(arguments)
    file = make_out(arguments.out, name="read.json")
    with RunProgress("flights") as progress:
        result = compare_codes(plan, on_flight=progress.update)
    if not result.rows:
        raise UserError(f"nothing could be flown: {result.missing[0][2]}")
    try:
        write_json(file, [row.figures() for row in result.rows])
        write_sheet(arguments.out / "read.png", result)
    except OSError as error:
        raise UserError(f"--out {arguments.out} cannot be written ({error.strerror}): name another") from None
    print_result(result)
    return 0


def print_result(result: ReadResult) -> None:
    """One line a method and rate."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:  # a file has room for every column
        console.width = max(console.width, _WIDTH)
    table = Table(
        title=f"{len(result.rows[0].codes())} codes, read by {result.reader}",
        caption="total, stills: kbps; then shares of the codes that were read right at least once:\n"
        "base, still, all: in base pictures, in stills, in both together\n"
        "<8, 8-11, >11: in both, by height of the characters in source pixels\n"
        "s: median from coming into view to that, - where less than half are read\n"
        "wrong: never read right, but misread as a code",
        caption_justify="left",
        title_justify="left",
        title_style="bold",
        box=None,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_column("kbps", justify="right", no_wrap=True)
    table.add_column("method", style="cyan", no_wrap=True)
    table.add_column("base", no_wrap=True)
    for head in ("total", "stills", "base", "still", "all", "<8", "8-11", ">11", "s", "wrong"):
        table.add_column(head, justify="right", no_wrap=True)
    before = None
    for row in result.rows:
        if before not in (None, row.rate_kbps):
            table.add_section()
        before = row.rate_kbps
        table.add_row(*_cells(row))
    console.print(table)
    for rate_kbps, method, reason in result.missing:
        console.print(f"{method} at {rate_kbps:g} kbps: not available, {reason}", markup=False)


def _cells(row: ReadRow) -> tuple[str, ...]:
    linked = row.method != "source"
    every = row.score("composite" if linked else "base")
    heights = row.by_height("composite" if linked else "base")
    return (
        f"{row.rate_kbps:g}" if linked else "",
        row.method,
        "; ".join(dict.fromkeys(_stream(one.flight.size, one.flight.fps) for one in row.scenes)),
        f"{row.mean('total_bps') / 1e3:.0f}" if linked else "",
        f"{row.mean('roi_bps') / 1e3:.0f}" if linked else "",
        _share(row.score("base")),
        _share(row.score("stills")) if row.mean("roi_bps") else "",
        _share(every),
        *map(_share, heights),
        "-" if every.median_s is None else f"{every.median_s:.1f}",
        _decimals(every.misread),
    )


def _stream(size: tuple[int, int], fps: float) -> str:
    return f"{size[0]}x{size[1]}@{fps:.3g}"


def _share(score: ChannelScore) -> str:
    return _decimals(score.read)


def _decimals(share: float | None) -> str:
    return "-" if share is None else f"{share:.2f}".removeprefix("0")


def _plan(arguments: argparse.Namespace) -> ReadPlan:
    size = parse_size(arguments.size, name="--size")
    check_shape(size=size, fps=15)
    if arguments.max_frames < _LEAST_FRAMES:
        raise UserError(f"--max-frames {arguments.max_frames} is too few: give {_LEAST_FRAMES} or more")
    return ReadPlan(
        dataset=arguments.dataset,
        models=ModelChoice(
            detector=arguments.detector, edge_detector=arguments.detector, provider=arguments.provider
        ),
        rates_bps=parse_rates(arguments.rates),
        cache=(arguments.out / "cache").absolute(),
        methods=chosen_names(arguments.methods, READ_METHODS),
        size=size,
        max_frames=arguments.max_frames,
    )
