"""``make bench``: memory, and speed as ratios against a peer or a floor, each pair measured in one run.

``python -m bench [NAME …]`` runs some; the table is also written to build/bench.json. Ends with code 1 where a bar
(bars.py) is missed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.bars import measured

PARTS = ("light", "memory", "latency", "pipeline", "joining", "tracker", "detector", "batching", "providers")


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="NAME", help=", ".join(PARTS))
    parts = parser.parse_args(argv).parts or PARTS
    for part in parts:
        if part not in PARTS:
            parser.error(f"{part} is not known: choose from {', '.join(PARTS)}")
    console = Console(highlight=False)
    table = Table(title="make bench", title_justify="left")
    for name in ("part", "measure", "value", "bar", "holds"):
        table.add_column(name, justify="left" if name in ("part", "measure") else "right")
    found = []
    for part in parts:
        with console.status(f"{part} …"):
            try:
                rows = importlib.import_module(f"bench.{part}").rows()
            except ImportError as error:
                rows = [measured(f"left out: {error}", None)]
        for row in rows:
            found.append({"part": part, **row})
            holds = {True: "yes", False: "NO", None: ""}[row["holds"]]
            value, bar = row["value"], row["bar"]
            shown = f"{value:.3f}" if isinstance(value, float) else str("" if value is None else value)
            table.add_row(part, row["measure"], shown, str("" if bar is None else bar), holds)
    console.print(table)
    out = Path("build/bench.json")
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    missed = [f"{row['part']}: {row['measure']}" for row in found if row["holds"] is False]
    for one in missed:
        print(f"bench: missed its bar: {one}", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
