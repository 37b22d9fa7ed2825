"""``make link``: edge and ground over bad links; one table, its rows in build/link.json, a picture in build/link.png.

Each run leaves its processes' output, the recording and the table of arrivals under build/link/SCENARIO.
"""

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from hvt_common.errors import exit_with_sentence
from lab.link.carriers.sides import UnavailableError, congestion_control
from lab.link.laboratory import CARRIERS, Run, run
from lab.link.material import demo_clip, looped
from lab.link.measures.outcome import Outcome, rate_over_time, rows
from lab.link.measures.rows import row, save, table
from lab.link.script import LENGTHS, load_scenario, scenario_names

BUILD = Path("build")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the scenarios of the arguments; 1 where a bar does not hold and ``--strict`` is given."""
    return exit_with_sentence(_run, program="link", argv=argv)


def _run(argv: Sequence[str] | None) -> int:
    arguments = _arguments(argv)
    names = arguments.scenarios or scenario_names()
    scenarios = [load_scenario(name) for name in names]
    clip = Path(arguments.clip) if arguments.clip else demo_clip(BUILD / "link" / "demo.mp4")
    console, found, outcomes = Console(highlight=False), [], []
    if arguments.carrier != "relay":
        console.print(f"the kernel's TCP paces itself by {congestion_control()}")
    for scenario in scenarios:
        folder = BUILD / "link" / scenario.name
        lasts_s = scenario.script(arguments.length, lasts=arguments.lasts).lasts_s
        wanted = Run(
            scenario=scenario,
            source=str(looped(clip, folder / "clip.ffconcat", lasts_s=lasts_s + 15)),
            folder=folder,
            length=arguments.length,
            lasts=arguments.lasts,
            carrier=arguments.carrier,
            seed=arguments.seed,
            edge_arguments=shlex.split(arguments.edge),
            ground_arguments=shlex.split(arguments.ground),
        )
        console.print(f"{scenario.name}, {lasts_s:g} s: {scenario.about}")
        measured, outcome = _one(wanted, bars=dict(scenario.bars))
        found += measured
        outcomes += [] if outcome is None else [outcome]
        save(found, BUILD / f"{arguments.name}.json")
    console.print(table(found, title="make link"))
    if outcomes:
        _drawn(outcomes, BUILD / f"{arguments.name}.png", console)
    return int(arguments.strict and any(one["holds"] is False for one in found))


def _one(wanted: Run, *, bars: dict[str, str]) -> tuple[list[dict[str, Any]], Outcome | None]:
    name = wanted.scenario.name
    try:
        outcome = run(wanted)
    except (UnavailableError, AssertionError) as error:
        print(f"{name}: did not run: {error}", file=sys.stderr)
        holds = None if isinstance(error, UnavailableError) else False
        said = str(error).splitlines()[0]
        return [{**row(name, "did not run", None, None), "value": said, "holds": holds}], None
    series = {"began_s": outcome.began_s, "delivered_bps": rate_over_time(outcome)}
    (wanted.folder / "series.json").write_text(json.dumps(series) + "\n", encoding="utf-8")
    return rows(outcome, bars), outcome


def _drawn(outcomes: Sequence[Outcome], path: Path, console: Console) -> None:
    try:
        from lab.link.measures.picture import draw  # matplotlib belongs to the study
    except ImportError:
        console.print("no picture: pip install 'hvt[study]' for matplotlib")
        return
    draw(outcomes, path)
    console.print(f"drawn: {path}")


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
    parser.add_argument("--carrier", choices=CARRIERS, default="relay")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--name", default="link", help="of the table and the picture in build/ [link]")
    parser.add_argument("--edge", default="", help="further arguments of hvt-edge, in one word")
    parser.add_argument("--ground", default="", help="further arguments of hvt-ground, in one word")
    parser.add_argument("--strict", action="store_true", help="exit code 1 where a bar does not hold")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
