"""``hvt-study demo``: what each of several flights of the drawn scene knew, and what could be read of it."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hvt_study.demo.compared import Compared, compare_flown
from hvt_study.demo.picture import write_picture

_WIDTH = 100


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
    """Print a line a flight, and write the picture."""
    installed = find_spec("rapidocr") is not None
    compared = compare_flown(arguments.folder, arguments.edges, seed=arguments.seed, with_reader=installed)
    write_picture(arguments.picture, compared.panels(), compared.pairs())
    _print(compared)
    return 0


def _print(compared: Compared) -> None:
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:  # a file has room for every column
        console.width = max(console.width, _WIDTH)
    table = Table(
        title="What the ground knew, on every frame", title_justify="left", title_style="bold", box=None
    )
    table.add_column("", style="cyan", no_wrap=True)
    for head in ("named F1", "false a frame", "class right", "codes read", "in stills alone", "kbps"):
        table.add_column(head, justify="right", no_wrap=True)
    for number, (one, score) in enumerate(zip(compared.flown, compared.scores, strict=True)):
        read, alone = "-", "-"
        if compared.legible is not None:
            legible = compared.legible[number]
            read = f"{len(legible.every)} of {len(compared.codes)}"
            alone = f"{len(legible.every - compared.legible[0].video - legible.video)}"
        figures = (f"{score.named_f1:.3f}", f"{score.false_per_frame:.1f}", f"{score.counts.top1_found:.3f}")
        table.add_row(one.name, *figures, read, alone, f"{one.total_bps / 1e3:.0f}")
    console.print(table)
    if compared.legible is not None:
        console.print(
            "codes read: right at least once, in six base pictures spread over the time in view, or in any still"
        )
    else:
        console.print("codes: counted where the reader is installed: pip install 'hvt[reading]'")
