"""``hvt-study read``: which codes on roofs can be read at the ground, and how soon, for the same bits?"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from hvt_common.errors import UserError
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.runtime.reporting import write_json
from hvt_common.values import Image
from hvt_study.commands import output
from hvt_study.commands.arguments import base_size, check_means, flown_frames, option, parse_rates
from hvt_study.reading.compared import READ_METHODS, ReadPlan, ReadResult, ReadRow, compare_codes
from hvt_study.reading.flight import Channel
from hvt_study.reading.score import Evidence
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
    check_means(arguments)
    plan = _plan(arguments)
    file = output.check_out(arguments.out, name="read.json")
    with output.RunProgress("flights") as progress:
        result = compare_codes(plan, on_flight=progress.update)
    if not result.rows:
        raise UserError(f"nothing could be flown: {result.missing[0][2]}")
    with output.writing(arguments.out):
        write_json(file, [row.figures() for row in result.rows])
        write_sheet(arguments.out / "read.png", result)
    print_result(result)
    return 0


def print_result(result: ReadResult) -> None:
    output.print_columns(
        f"{len(result.rows[0].codes())} codes, read by {result.reader}",
        _HEADS,
        map(_cells, result.rows),
        words=("method", "video"),
        gap=1,
        caption=_CAPTION,
    )
    for rate_kbps, method, reason in result.missing:
        output.print_lines(f"{method} at {rate_kbps:g} kbps: not available, {reason}")


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
        output.share(row.score("base").read, 2),
        output.share(row.score("stills").read, 2) if row.mean("roi_bps") else "",
        output.share(every.read, 2),
        *(output.share(one.read, 2) for one in heights),
        output.decimals(every.median_s, 1),
        output.share(every.misread, 2),
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


_ROWS = 10
_CELL_PX = (196, 60)
_TEXT_PX = 20
_HEAD_PX = 24
_INK, _GREEN, _RED, _GREY = (30, 30, 30), (40, 130, 30), (40, 40, 200), (150, 150, 150)
_PAPER = 246


def write_sheet(path: Path, result: ReadResult) -> None:
    """Write a PNG of up to ten codes of the first scene at the lowest rate; nothing where nothing was flown.

    First come codes that some methods showed and others did not. Raises `OSError` where it cannot be written.
    """
    flown = [row for row in result.rows if row.method != "source"]
    if not flown:
        path.unlink(missing_ok=True)
        return
    lowest = min(row.rate_kbps for row in flown)
    rows = [row for row in result.rows if row.rate_kbps in (0, lowest)]
    both: tuple[Channel, ...] = "base", "stills"
    columns = [(row, channel) for row in rows for channel in (both if row.mean("roi_bps") else both[:1])]
    picture = np.vstack(
        [_line([f"at {lowest:g} kbps", *(_title(*one) for one in columns)], high_px=_HEAD_PX)]
        + [_row(object_id, columns) for object_id in _chosen(columns)]
    )
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def _title(row: ReadRow, channel: Channel) -> str:
    if row.method == "source":
        return "source"
    if channel == "stills":
        return f"{row.method}, still"
    flight = row.scenes[0].flight
    return f"{row.method} {flight.size[0]}x{flight.size[1]} {flight.fps:.1f} fps"


def _chosen(columns: Sequence[tuple[ReadRow, Channel]]) -> list[int]:
    """Objects of the first scene, those first on which the methods differ most, the small before the large."""
    scene = columns[0][0].scenes[0]
    links = [one for one in columns if one[0].method != "source"]

    def order(object_id: int) -> tuple[bool, float]:
        right = {one.right for one in (_evidence(object_id, *column) for column in links)}
        return len(right) < 2, scene.codes[object_id].height_px

    return sorted(scene.codes, key=order)[:_ROWS]


def _evidence(object_id: int, row: ReadRow, channel: Channel) -> Evidence:
    return row.scenes[0].flight.evidence[channel].get(object_id, Evidence())


def _row(object_id: int, columns: Sequence[tuple[ReadRow, Channel]]) -> Image:
    code = columns[0][0].scenes[0].codes[object_id]
    head = _cell(None, code.text, f"{code.height_px:.0f} px high", _INK)
    return np.hstack([head, *(_shown(_evidence(object_id, *column)) for column in columns)])


def _shown(one: Evidence) -> Image:
    if one.best is None:
        return _cell(None, "", "not shown", _GREY)
    if one.right:
        return _cell(one.best.picture_bgr, "", f"{one.best.text} at {one.read_s:.1f} s", _GREEN)
    return _cell(one.best.picture_bgr, "", one.best.text or "?", _RED)


def _cell(crop: Image | None, title: str, text: str, colour: tuple[int, int, int]) -> Image:
    wide, high = _CELL_PX
    cell = np.full((high + _TEXT_PX, wide, 3), _PAPER, np.uint8)
    if crop is not None:
        zoom = min((wide - 8) / crop.shape[1], (high - 8) / crop.shape[0])
        size = max(1, round(crop.shape[1] * zoom)), max(1, round(crop.shape[0] * zoom))
        small = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
        left, top = (wide - size[0]) // 2, (high - size[1]) // 2
        cell[top : top + size[1], left : left + size[0]] = small
    _write(cell, title, (8, high - 22), colour, scale=0.8)
    # The reader may find signs that this font lacks.
    _write(cell, text.encode("ascii", "replace").decode(), (8, high + 12), colour, scale=0.42)
    return cell


def _line(texts: Sequence[str], *, high_px: int) -> Image:
    cells = [np.full((high_px, _CELL_PX[0], 3), _PAPER - 16, np.uint8) for _ in texts]
    for cell, text in zip(cells, texts, strict=True):
        _write(cell, text, (6, 16), _INK, scale=0.4)
    return np.hstack(cells)


def _write(
    cell: Image, text: str, place: tuple[int, int], colour: tuple[int, int, int], *, scale: float
) -> None:
    cv2.putText(cell, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
