"""``hvt-study read``: which codes on roofs can be read at the ground, and how soon, for the same bits?"""

from __future__ import annotations

import argparse

from hvt_common.errors import UserError
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.runtime.reporting import write_json
from hvt_study.commands.arguments import base_size, flown_frames, option, parse_rates
from hvt_study.commands.output import (
    RunProgress,
    decimals,
    make_out,
    print_columns,
    print_lines,
    share,
    writing,
)
from hvt_study.reading.compared import READ_METHODS, ReadPlan, ReadResult, ReadRow, compare_codes
from hvt_study.reading.sheet import write_sheet
from hvt_study.runs.methods import chosen_names
from hvt_study.runs.spec import ModelChoice

_HEADS = (
    *("kbps", "method", "video", "total", "stills", "base", "still", "all", "<8", "8-11", ">11"),
    *("s", "wrong"),
)
_CAPTION = (
    "total, stills: kbps; then shares of the codes that were read right at least once:\n"
    "base, still, all: in base pictures, in stills, in both together\n"
    "<8, 8-11, >11: in both, by height of the characters in source pixels\n"
    "s: median from coming into view to that, - where less than half are read\n"
    "wrong: never read right, but misread as a code"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Scenes, models, rates, methods, and where the results go."""
    parser.add_argument(
        "dataset", metavar="DEMO", help="drawn scenes with codes: demo:codes, demo:0-4,codes, demo:codes,4k"
    )
    help_text = "of edge and ground, which decides what gets a still: FILE.onnx or a model's name"
    option(parser, "--detector", default=EMBEDDED_DETECTOR, help=help_text)
    option(parser, "--rates", default="150,300")
    option(parser, "--methods", default=",".join(READ_METHODS))
    option(parser, "--size")
    option(parser, "--max-frames", default=150, help="frames of a scene, 15 a second")
    option(parser, "--out", help="read.json, read.png, and cache, where finished flights lie")
    option(parser, "--provider", help="what runs the detector, as of hvt-edge")


def run(arguments: argparse.Namespace) -> int:
    """Fly, read, print the table, write it and a sheet of examples."""
    plan = _plan(arguments)
    file = make_out(arguments.out, name="read.json")
    with RunProgress("flights") as progress:
        result = compare_codes(plan, on_flight=progress.update)
    if not result.rows:
        raise UserError(f"nothing could be flown: {result.missing[0][2]}")
    with writing(arguments.out):
        write_json(file, [row.figures() for row in result.rows])
        write_sheet(arguments.out / "read.png", result)
    print_result(result)
    return 0


def print_result(result: ReadResult) -> None:
    """One line a method and rate."""
    print_columns(
        f"{len(result.rows[0].codes())} codes, read by {result.reader}",
        _HEADS,
        map(_cells, result.rows),
        words=("method", "video"),
        gap=1,
        caption=_CAPTION,
    )
    for rate_kbps, method, reason in result.missing:
        print_lines(f"{method} at {rate_kbps:g} kbps: not available, {reason}")


def _cells(row: ReadRow) -> tuple[str, ...]:
    linked = row.method != "source"
    every = row.score("composite" if linked else "base")
    heights = row.by_height("composite" if linked else "base")
    flights = (one.flight for one in row.scenes)
    streams = (f"{one.size[0]}x{one.size[1]}@{one.fps:.3g}" for one in flights)
    return (
        f"{row.rate_kbps:g}" if linked else "",
        row.method,
        "; ".join(dict.fromkeys(streams)),
        f"{row.mean('total_bps') / 1e3:.0f}" if linked else "",
        f"{row.mean('roi_bps') / 1e3:.0f}" if linked else "",
        share(row.score("base").read, 2),
        share(row.score("stills").read, 2) if row.mean("roi_bps") else "",
        share(every.read, 2),
        *(share(one.read, 2) for one in heights),
        decimals(every.median_s, 1),
        share(every.misread, 2),
    )


def _plan(arguments: argparse.Namespace) -> ReadPlan:
    return ReadPlan(
        dataset=arguments.dataset,
        models=ModelChoice(
            detector=arguments.detector, edge_detector=arguments.detector, provider=arguments.provider
        ),
        rates_bps=parse_rates(arguments.rates),
        cache=(arguments.out / "cache").absolute(),
        methods=chosen_names(arguments.methods, READ_METHODS),
        size=base_size(arguments.size),
        max_frames=flown_frames(arguments.max_frames),
    )
