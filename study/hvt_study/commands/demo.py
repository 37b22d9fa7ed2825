"""``hvt-study demo``: compares several flights of the drawn scene by their tracks and by the readable codes."""

import argparse
from importlib.util import find_spec
from pathlib import Path

from hvt_study.commands.output import print_columns, print_lines
from hvt_study.demo.compared import Compared, compare_flown
from hvt_study.demo.picture import write_picture


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where the flights lie, which they are, and the picture."""
    parser.add_argument(
        "folder",
        type=Path,
        help="what hvt-ground --record, --tracks and --stills (stills/) and hvt-edge --summary "
        "(EDGE-edge.json) wrote",
    )
    parser.add_argument("edges", nargs="+", metavar="EDGE", help="ids of the edges; video alone comes first")
    parser.add_argument("--seed", type=int, default=0, help="of the scene demo:codes that they saw")
    parser.add_argument("--picture", type=Path, default=Path("demo.png"), metavar="FILE.png", help="to write")


def run(arguments: argparse.Namespace) -> int:
    installed = find_spec("rapidocr") is not None
    compared = compare_flown(arguments.folder, arguments.edges, seed=arguments.seed, with_reader=installed)
    write_picture(arguments.picture, compared.panels(), compared.pairs())
    _print(compared)
    return 0


def _print(compared: Compared) -> None:
    rows = []
    for number, (one, score) in enumerate(zip(compared.flown, compared.scores, strict=True)):
        read, alone = "-", "-"
        if compared.legible is not None:
            legible = compared.legible[number]
            read = f"{len(legible.every)} of {len(compared.painted.codes)}"
            alone = f"{len(legible.every - compared.legible[0].video - legible.video)}"
        figures = (f"{score.named_f1:.3f}", f"{score.false_per_frame:.1f}", f"{score.counts.top1_found:.3f}")
        rows.append((one.name, *figures, read, alone, f"{one.total_bps / 1e3:.0f}"))
    heads = ("", "named F1", "false a frame", "class right", "codes read", "in stills alone", "kbps")
    print_columns("What the ground knew, on every frame", heads, rows, words=("",), gap=2)
    if compared.legible is not None:
        print_lines(
            "codes read: right at least once, in six base pictures spread over the time in view, or in any still"
        )
    else:
        print_lines("codes: counted where the reader is installed: pip install 'hvt[reading]'")
