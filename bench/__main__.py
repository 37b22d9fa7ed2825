"""``make bench``: memory, and speed as ratios against a peer or a floor, each pair measured in one run.

``python -m bench [NAME …]`` runs some; the table is also written to build/bench.json. Ends with code 1 where a bar
(bars.py) is missed.
"""

import argparse
import importlib
import sys
from pathlib import Path

from rich.console import Console

from bench.bars import measured
from lab.link.measures.rows import save, table

PARTS = ("light", "memory", "latency", "pipeline", "joining", "tracker", "detector", "batching", "providers")


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="NAME", help=", ".join(PARTS))
    parts = parser.parse_args(argv).parts or PARTS
    for part in parts:
        if part not in PARTS:
            parser.error(f"{part} is not known: choose from {', '.join(PARTS)}")
    console, found = Console(highlight=False), []
    for part in parts:
        with console.status(f"{part} …"):
            try:
                rows = importlib.import_module(f"bench.{part}").rows()
            except ImportError as error:
                rows = [measured(f"left out: {error}", None)]
        found += [{"part": part, **row} for row in rows]
    console.print(table(found, title="make bench"))
    save(found, Path("build/bench.json"))
    missed = [f"{row['part']}: {row['measure']}" for row in found if row["holds"] is False]
    for one in missed:
        print(f"bench: missed its bar: {one}", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
