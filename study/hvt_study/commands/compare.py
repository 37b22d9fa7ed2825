"""``hvt-study compare``: what does the ground show at this budget, on my clip, with each method?"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import write_json
from hvt_study.commands.arguments import (
    add_pool_arguments,
    base_size,
    flown_frames,
    names_of,
    open_pool,
    option,
    parse_rates,
)
from hvt_study.commands.output import (
    RunProgress,
    decimals,
    make_out,
    print_columns,
    print_lines,
    share,
    writing,
)
from hvt_study.matrix.compare import COMPARED, ComparePlan, CompareResult, CompareRow, compare
from hvt_study.matrix.verdict import Verdict, verdicts
from hvt_study.runs.methods import chosen_names
from hvt_study.runs.spec import ModelChoice

_CLIPS = "a video, a folder of images, a MOTChallenge sequence (img1/, gt/gt.txt), demo, or still:PICTURE"
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
    help_text = "of the ground and of the reference labels: FILE.onnx or a model's name"
    option(parser, "--detector", required=True, help=help_text)
    option(parser, "--edge-detector")
    option(parser, "--rates", default="150,200,300,400,800")
    option(parser, "--methods", default=",".join(COMPARED))
    option(parser, "--out", help="compare.json, compare.png, and cache, where finished flights lie")
    size = "size of the base stream (default: 1280x720, or what the source fills of it)"
    option(parser, "--size", default=argparse.SUPPRESS, help=size)
    option(parser, "--max-frames", default=300)
    add_pool_arguments(parser)
    parser.add_argument(
        "--labels",
        default="auto",
        choices=("auto", "exact", "reference"),
        help="exact where the source knows them, or what the detector says of untouched frames",
    )
    option(parser, "--classes")
    option(parser, "--labelled")
    option(parser, "--provider")


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

    with writing(folder):
        write_json(file, list(result.rows))
        plot(result, folder / "compare.png")
    print_result(result)
    print_verdicts(verdicts(plan, result))
    return 0


def print_result(result: CompareResult) -> None:
    """One line a method and rate: named F1 of the whole clip, and of both halves beside it."""
    headline = "recall" if result.one_target else "named_f1"
    rows = (
        (
            f"{whole['rate_kbps']:g}",
            whole["method"],
            share(whole[headline]),
            f"{share(first[headline])} {share(second[headline])}",
            *(_held(whole) if result.one_target else _listed(whole)),
        )
        for whole, first, second in result.flights
    )
    heads = ("kbps", "method", *(_ONE_TARGET_HEADS if result.one_target else _HEADS))
    print_columns(f"{result.clip}, {result.labels} labels", heads, rows, words=("method",), gap=1)
    print_lines(_ONE_TARGET_LEGEND if result.one_target else _LEGEND)
    for one in result.missing:
        print_lines(f"{one.method} at {one.rate_kbps:g} kbps: not available, {one.reason}")


def print_verdicts(found: Sequence[Verdict]) -> None:
    """What to fly at each rate, and how."""
    for one in found:
        print_lines(f"\n{one.sentence}", *([f"fly this: {one.command}"] if one.command else []))


def _listed(row: CompareRow) -> tuple[str, ...]:
    return (
        decimals(row["false_per_frame"], 1),
        share(row["class_agreement"]),
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
    return share(named), gaps, decimals(row["longest_gap_s"], 1), switches, total, *_pace(row)


def _pace(row: CompareRow) -> tuple[str, ...]:
    return f"{row['fps']:.1f}", f"{row['delay_p95_ms']:.0f}", f"{row['edge_cpu_ms']:.0f}"


def _plan(arguments: argparse.Namespace) -> ComparePlan:
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
        size=base_size(arguments.size) if hasattr(arguments, "size") else None,
        max_frames=flown_frames(arguments.max_frames),
        labels=arguments.labels,
        classes=names_of(arguments.classes),
        labelled=names_of(arguments.labelled),
    )
