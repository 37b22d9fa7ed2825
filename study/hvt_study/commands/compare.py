"""``hvt-study compare``: what does the ground show at this budget, on my clip, with each method?"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from types import MappingProxyType

from hvt_common.errors import UserError
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.runtime.reporting import write_json
from hvt_study.commands import arguments as common
from hvt_study.commands import output
from hvt_study.datasets.label_files import in_any_case
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.datasets.virtual_camera import SCHEME
from hvt_study.matrix.compare import COMPARED, ComparePlan, CompareResult, CompareRow, compare
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
    help_text = "detector of the ground and of reference labels: FILE.onnx or a model's name"
    common.option(parser, "--detector", required=True, help=help_text)
    common.option(parser, "--edge-detector")
    common.option(parser, "--rates", default="150,200,300,400,800")
    common.option(parser, "--methods", default=",".join(COMPARED))
    common.option(parser, "--out", help="compare.json, compare.png, and cache, where finished flights lie")
    size = "size of the base stream (default: 1280x720, or what the source fills of it)"
    common.option(parser, "--size", default=argparse.SUPPRESS, help=size)
    common.option(parser, "--max-frames", default=300)
    common.add_pool_arguments(parser)
    parser.add_argument(
        "--labels",
        default="auto",
        choices=("auto", "exact", "reference"),
        help="what counts as true: exact labels of the source, or reference: the detector on untouched frames",
    )
    common.option(parser, "--classes")
    common.option(parser, "--labelled")
    common.option(parser, "--provider")


def run(arguments: argparse.Namespace) -> int:
    common.check_means(arguments)
    plan = _plan(arguments)
    folder: Path = arguments.out
    file = output.check_out(folder, name="compare.json")
    opened, _ = common.open_pool(arguments)
    with output.RunProgress("runs") as progress, opened as pool:
        result = compare(
            plan, pool=pool, on_run=lambda done, of, alike: progress.update(done, of, alike=alike)
        )
    if not result.rows:
        raise UserError(f"nothing could be flown: {result.missing[0].reason}")
    from hvt_study.report.figures.drawing import plot  # noqa: PLC0415 - Matplotlib, before it says a word

    with output.writing(folder):
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
            output.share(whole[headline]),
            f"{output.share(first[headline])} {output.share(second[headline])}",
            *(_held(whole) if result.one_target else _listed(whole)),
        )
        for whole, first, second in result.flights
    )
    heads = ("kbps", "method", *(_ONE_TARGET_HEADS if result.one_target else _HEADS))
    output.print_columns(f"{result.clip}, {result.labels} labels", heads, rows, words=("method",), gap=1)
    output.print_lines(_ONE_TARGET_LEGEND if result.one_target else _LEGEND)
    for one in result.missing:
        output.print_lines(f"{one.method} at {one.rate_kbps:g} kbps: not available, {one.reason}")


def print_verdicts(found: Sequence[Verdict]) -> None:
    """Print the best method at each rate, and its settings."""
    for one in found:
        output.print_lines(f"\n{one.sentence}", *([f"fly this: {one.command}"] if one.command else []))


def _listed(row: CompareRow) -> tuple[str, ...]:
    return (
        output.decimals(row["false_per_frame"], 1),
        output.share(row["class_agreement"]),
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
    return output.share(named), gaps, output.decimals(row["longest_gap_s"], 1), switches, total, *_pace(row)


def _pace(row: CompareRow) -> tuple[str, ...]:
    return f"{row['fps']:.1f}", output.decimals(row["delay_p95_ms"], 0), f"{row['edge_cpu_ms']:.0f}"


def _plan(arguments: argparse.Namespace) -> ComparePlan:
    return ComparePlan(
        clip=arguments.clip,
        models=ModelChoice(
            detector=arguments.detector,
            edge_detector=getattr(arguments, "edge_detector", arguments.detector),
            provider=arguments.provider,
        ),
        rates_bps=common.parse_rates(arguments.rates),
        cache=(arguments.out / "cache").absolute(),
        methods=chosen_names(arguments.methods, COMPARED),
        size=common.base_size(arguments.size) if hasattr(arguments, "size") else None,
        max_frames=common.flown_frames(arguments.max_frames),
        labels=arguments.labels,
        classes=common.names_of(arguments.classes),
        labelled=common.names_of(arguments.labelled),
    )


NOISE = 0.01
"""Two figures that differ by less are alike."""
SIMPLEST_FIRST: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "M0": ("--method", "M0"),
        "M0-fps": ("--method", "M0"),
        "M0-best": ("--method", "M0"),
        "R0": ("--method", "R0"),
        "tracks": ("--profile", "tracks"),
        "M5-jpeg": ("--profile", "M5-jpeg"),
        "M5-residual": ("--profile", "M5-residual"),
        "auto": ("--profile", "auto"),
        "M6": ("--profile", "thin"),
    }
)
"""Names of `COMPARED`, from the one with the fewest parts on, with the names of ``hvt-edge``."""
_STALE_MS = 500
_MEASURES = {"named_f1": "named F1", "recall": "recall"}
"""Recall where one target is labelled."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on one budget."""

    sentence: str
    command: str
    """Empty where nothing is worth flying."""


def verdicts(plan: ComparePlan, result: CompareResult) -> tuple[Verdict, ...]:
    """One a budget, in order; judged by named F1 of the whole clip, or by recall where one target is labelled."""
    wholes = (whole for whole, _, _ in result.flights)
    by_rate = groupby(wholes, key=lambda row: row["rate_kbps"])
    return tuple(_verdict(plan, rate, {row["method"]: row for row in rows}) for rate, rows in by_rate)


def command_of(plan: ComparePlan, row: CompareRow) -> str:
    """The edge's command line for a flight of the comparison; for a picture the camera is to be filled in."""
    width, height = row["base_width"], row["base_height"]
    words = ["hvt-edge", "--source", *_source(plan), "--budget", f"{row['rate_kbps']:g}kbps"]
    words += ["--size", f"{width}x{height}", *SIMPLEST_FIRST[row["method"]]]
    fps = row["set_fps"]
    if fps is not None and fps != NOMINAL_FPS:
        words += ["--fps", f"{fps:g}"]
        if fps < 2:  # the budget's window has to hold two frames
            words += ["--window", f"{2 / fps:g}s"]
    if plan.models.edge_detector != EMBEDDED_DETECTOR:
        words += ["--detector", plan.models.edge_detector]
    return shlex.join(words)


def _source(plan: ComparePlan) -> tuple[str, ...]:
    if plan.clip.startswith(SCHEME):
        return ("CAMERA",)
    pictures = in_any_case(Path(plan.clip) / "img1")
    return (str(pictures),) if pictures.is_dir() else (plan.clip,)


def _verdict(plan: ComparePlan, rate_kbps: float, rows: Mapping[str, CompareRow]) -> Verdict:
    begins = f"At {rate_kbps:g} kbps"
    known = [one for one in _MEASURES if any(row[one] is not None for row in rows.values())]
    if not known:
        return Verdict(f"{begins} nothing can be judged: no object of the clip counts.", "")
    name = _MEASURES[known[0]]
    worth = {method: row[known[0]] or 0.0 for method, row in rows.items()}
    most = max(worth.values())
    if not most:
        return Verdict(f"{begins} no method shows anything right ({name} .000).", "")
    chosen = next(method for method in SIMPLEST_FIRST if method in worth and most - worth[method] < NOISE)
    row = rows[chosen]
    said = f"{begins} fly {_named(row)}: {name} {_of_one(worth[chosen])}"
    others = {method: value for method, value in worth.items() if method != chosen}
    if others:
        said += _against(chosen, worth[chosen], others)
    age_ms = row["picture_age_p95_ms"] or 0
    if age_ms > _STALE_MS:
        said += f" Its newest picture is up to {age_ms / 1e3:.1f} s old."
    return Verdict(said, command_of(plan, row))


def _against(chosen: str, value: float, others: Mapping[str, float]) -> str:
    other = max(others, key=lambda method: others[method])
    gap = value - others[other]
    if gap >= NOISE:
        return f", {_of_one(gap)} more than the next, {other}."
    alike = [method for method, found in others.items() if abs(value - found) < NOISE]
    return (
        f". {', '.join(alike)} within {_of_one(NOISE)[:3]}, which is no difference: {chosen} is the simplest."
    )


def _named(row: CompareRow) -> str:
    method, fps = str(row["method"]), row["set_fps"]
    size = f"{row['base_width']}x{row['base_height']} and " if method == "M0-best" else ""
    return method if fps is None else f"{method} at {size}{fps:g} frames a second"


def _of_one(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")
