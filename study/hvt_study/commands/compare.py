"""``hvt-study compare``: what does the ground show at this budget, on my clip, with each method?"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import write_json
from hvt_common.units import parse_size
from hvt_edge.source.contract import check_shape
from hvt_study.commands.arguments import add_pool_arguments, make_out, open_pool, parse_rates
from hvt_study.commands.progress import RunProgress
from hvt_study.matrix.compare import COMPARED, ComparePlan, CompareResult, CompareRow, compare
from hvt_study.matrix.verdict import Verdict, verdicts
from hvt_study.runs.methods import chosen_names
from hvt_study.runs.spec import ModelChoice

_CLIPS = "a video, a folder of images, a MOTChallenge sequence (img1/, gt/gt.txt), demo, or still:PICTURE"
_LEAST_FRAMES = 30
_HEADS = ("named", "halves", "false", "class", "all", "base", "still", "track", "fps", "p95", "CPU")
_ONE_TARGET_HEADS = ("found", "halves", "named", "gaps", "worst", "ids", "all", "fps", "p95", "CPU")
_ONE_TARGET_LEGEND = (
    "one target is labelled, nothing else that is in view: nobody knows which of the other objects are false\n"
    "found: share of its time at which the target is found, .000: never; named: found with its class;\n"
    "gaps: times it was lost after it was found; worst: the longest, s; ids: changes of its id; -: no figure\n"
    "all: kbps; p95: delay of frames, ms; CPU: of the edge, ms a frame"
)
_LEGEND = (
    "named: named F1, 1 where each object is shown with its class and nothing else is;\n"
    "   .000: nothing is shown right; -: there is nothing to judge\n"
    "halves: named F1 of each half of the clip; false: objects a frame that are on no\n"
    "   label or of another class; class: share of the found that have their class\n"
    "all to track: kbps; p95: delay of frames, ms; CPU: of the edge, ms a frame"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Clip, models, rates, methods, and where the results go."""
    parser.add_argument("clip", metavar="CLIP", help=_CLIPS)
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
    parser.add_argument(
        "--size",
        metavar="WxH",
        help="size of the base stream (default: 1280x720, or what the source fills of it)",
    )
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
    parser.add_argument("--classes", default="", metavar="NAME,…", help="of YOLO labels without classes.txt")
    parser.add_argument(
        "--labelled",
        default="",
        metavar="KIND,…",
        help="kinds that the labels know, such as vehicle; others count neither way (default: all they name)",
    )
    parser.add_argument(
        "--provider",
        default="cpu",
        help="what runs the networks, as of hvt-edge; auto may choose another each time",
    )


def run(arguments: argparse.Namespace) -> int:
    """Fly, print the table, write it and the plot."""
    plan = _plan(arguments)
    folder: Path = arguments.out
    file = make_out(folder, name="compare.json")
    opened, jobs = open_pool(arguments)
    with RunProgress("flights") as progress, opened as pool:
        result = compare(plan, pool=pool, workers=jobs, on_flights=progress.update)
    if not result.rows:
        raise UserError(f"nothing could be flown: {result.missing[0].reason}")
    from hvt_study.report.figures.compare_plot import plot  # noqa: PLC0415 - Matplotlib, before it says a word

    try:
        write_json(file, list(result.rows))
        plot(result, folder / "compare.png")
    except OSError as error:
        raise UserError(f"--out {folder} cannot be written ({error.strerror}): name another") from None
    print_result(result)
    print_verdicts(verdicts(plan, result))
    return 0


def print_result(result: CompareResult) -> None:
    """One line a method and rate: named F1 of the whole clip, and of both halves beside it."""
    console = Console(highlight=False, markup=False)
    table = Table(
        title=f"{result.clip}, {result.labels} labels",
        title_justify="left",
        title_style="bold",
        box=None,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for head, style in (("kbps", None), ("method", "cyan")):
        table.add_column(head, justify="left" if style else "right", style=style, no_wrap=True)
    for head in _ONE_TARGET_HEADS if result.one_target else _HEADS:
        table.add_column(head, justify="right", no_wrap=True)
    before = None
    for whole, first, second in result.flights:
        if before not in (None, whole["rate_kbps"]):
            table.add_section()
        before = whole["rate_kbps"]
        headline = "recall" if result.one_target else "named_f1"
        halves = f"{_share(first[headline])} {_share(second[headline])}"
        cells = _held(whole) if result.one_target else _listed(whole)
        table.add_row(f"{before:g}", whole["method"], _share(whole[headline]), halves, *cells)
    console.print(table)
    console.print(_ONE_TARGET_LEGEND if result.one_target else _LEGEND, markup=False, soft_wrap=True)
    for one in result.missing:
        console.print(f"{one.method} at {one.rate_kbps:g} kbps: not available, {one.reason}", markup=False)


def print_verdicts(found: Sequence[Verdict]) -> None:
    """What to fly at each rate, and how."""
    console = Console(highlight=False, markup=False)
    for one in found:
        console.print(f"\n{one.sentence}", markup=False, soft_wrap=True)
        if one.command:
            console.print(f"fly this: {one.command}", markup=False, soft_wrap=True)


def _listed(row: CompareRow) -> tuple[str, ...]:
    return (
        _number(row["false_per_frame"]),
        _share(row["class_agreement"]),
        f"{row['total_bps'] / 1e3:.0f}",
        f"{row['base_bps'] / 1e3:.0f}",
        f"{row['roi_bps'] / 1e3:.0f}",
        f"{row['track_bps'] / 1e3:.1f}",
        *_pace(row),
    )


def _held(row: CompareRow) -> tuple[str, ...]:
    named = None if row["class_agreement"] is None else row["class_agreement"] * row["recall"]
    counts = ("-" if row[name] is None else str(row[name]) for name in ("gaps", "id_switches"))
    gaps, switches = counts
    total = f"{row['total_bps'] / 1e3:.0f}"
    return _share(named), gaps, _number(row["longest_gap_s"]), switches, total, *_pace(row)


def _pace(row: CompareRow) -> tuple[str, ...]:
    return f"{row['fps']:.1f}", f"{row['delay_p95_ms']:.0f}", f"{row['edge_cpu_ms']:.0f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}".replace("0.", ".")


def _plan(arguments: argparse.Namespace) -> ComparePlan:
    size = None if arguments.size is None else parse_size(arguments.size, name="--size")
    if size is not None:
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
        rates_bps=parse_rates(arguments.rates),
        cache=(arguments.out / "cache").absolute(),
        methods=chosen_names(arguments.methods, COMPARED),
        size=size,
        max_frames=arguments.max_frames,
        labels=arguments.labels,
        classes=_words(arguments.classes),
        labelled=_words(arguments.labelled),
    )


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())
