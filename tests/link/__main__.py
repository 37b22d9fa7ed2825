"""``make link``: edge and ground over bad links; one table, and its rows in build/link.json.

Each run leaves its processes' output, the recording and the table of arrivals under build/link/SCENARIO.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from hvt_common.errors import exit_with_sentence
from link.laboratory import Run, run
from link.material import demo_clip, looped
from link.measures import rate_over_time, rows
from link.netns import UnavailableError
from link.script import LENGTHS, load_scenario, scenario_names

BUILD = Path("build")


def main(argv: Sequence[str] | None = None) -> int:
    """Run what is asked for; 1 where a bar does not hold and ``--strict`` is given."""
    return exit_with_sentence(_run, program="link", argv=argv)


def _run(argv: Sequence[str] | None) -> int:
    asked = _arguments(argv)
    names = asked.scenarios or scenario_names()
    scenarios = [load_scenario(name) for name in names]
    clip = Path(asked.clip) if asked.clip else demo_clip(BUILD / "link" / "demo.mp4")
    console, found = Console(highlight=False), []
    for scenario in scenarios:
        folder = BUILD / "link" / scenario.name
        wanted = Run(
            scenario=scenario,
            source=str(folder / "clip.mp4"),
            folder=folder,
            length=asked.length,
            lasts=asked.lasts,
            carrier=asked.carrier,
            seed=asked.seed,
            edge_arguments=shlex.split(asked.edge),
            ground_arguments=shlex.split(asked.ground),
        )
        script = wanted.script
        looped(clip, folder / "clip.mp4", lasts_s=script.lasts_s + 15)
        console.print(f"{scenario.name}, {script.lasts_s:g} s: {scenario.about}")
        found += _one(wanted, bars=dict(scenario.bars))
    console.print(_table(found))
    (BUILD / "link.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return int(asked.strict and any(row["holds"] is False for row in found))


def _one(wanted: Run, *, bars: dict[str, str]) -> list[dict[str, Any]]:
    try:
        outcome = run(wanted)
    except (UnavailableError, AssertionError) as error:
        print(f"{wanted.scenario.name}: did not run: {error}", file=sys.stderr)
        reason = {
            "scenario": wanted.scenario.name,
            "measure": "did not run",
            "value": str(error).splitlines()[0],
        }
        return [{**reason, "bar": None, "holds": None if isinstance(error, UnavailableError) else False}]
    series = {"began_s": outcome.began_s, "delivered_bps": rate_over_time(outcome)}
    (wanted.folder / "series.json").write_text(json.dumps(series) + "\n", encoding="utf-8")
    return [_finite(row) for row in rows(outcome, bars)]


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """JSON knows no infinity."""
    value = row["value"]
    return {**row, "value": "never"} if isinstance(value, float) and math.isinf(value) else row


def _table(found: list[dict[str, Any]]) -> Table:
    table = Table(title="make link", title_justify="left")
    for name in ("scenario", "measure", "value", "bar", "holds"):
        table.add_column(name, justify="left" if name in ("scenario", "measure") else "right")
    for row in found:
        holds = {True: "yes", False: "NO", None: ""}[row["holds"]]
        value = row["value"]
        shown = f"{value:.2f}" if isinstance(value, float) else "" if value is None else str(value)
        table.add_row(row["scenario"], row["measure"], shown, row["bar"] or "", holds)
    return table


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "scenarios", nargs="*", help=f"some of {', '.join(scenario_names())}, or FILE.toml [all]"
    )
    parser.add_argument("--clip", default="", help="what the edge plays, repeated as needed [the demo scene]")
    parser.add_argument("--length", choices=LENGTHS, default="full")
    parser.add_argument("--lasts", help="another length, such as 60min for a soak")
    parser.add_argument("--carrier", choices=["relay", "netns"], default="relay")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--edge", default="", help="further arguments of hvt-edge, in one word")
    parser.add_argument("--ground", default="", help="further arguments of hvt-ground, in one word")
    parser.add_argument("--strict", action="store_true", help="exit code 1 where a bar does not hold")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
