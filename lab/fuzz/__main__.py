"""``make fuzz``: a coverage-guided fuzzer over everything that takes bytes from outside.

First the seeds of every target run once: a target that cannot start ends the whole run with exit code 2. Then each
target runs in a process of its own, one after the other, until its share of the inputs is done. One that breaks
begins again with the rest, with its finding set aside. At the end there is one table, and its rows are in
build/fuzz/summary.json.
"""

import argparse
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.table import Table

from lab.fuzz.contract import CannotStartError, checked_seeds
from lab.fuzz.table import TARGETS

BUILD = Path("build/fuzz")
RUNS = 1_000_000
_COVERAGE = re.compile(rb"cov: (\d+) .*corp: (\d+)/")
_NO_START = "no start"
_WARM = 0.2
"""Memory counts from this share of the inputs on."""


@dataclass(frozen=True, slots=True)
class TargetResult:
    """The result of one target."""

    target: str
    inputs: int
    inputs_per_s: float
    corpus: int
    coverage: int
    """Edges of our own Python code that were reached."""
    slowest_ms: float
    growth_mb: float
    """Resident memory at the end against that at a fifth of the inputs."""
    findings: tuple[str, ...]


def main(argv: Sequence[str] | None = None) -> int:
    """1 where anything was found, 2 where a target cannot start."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [name for name, target in TARGETS.items() if target.share]
    parser.add_argument("--runs", type=int, default=RUNS, help=f"inputs over all targets [{RUNS}]")
    parser.add_argument("--target", action="append", metavar="NAME", help=f"some of {', '.join(names)} [all]")
    parser.add_argument("--folder", type=Path, default=BUILD)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument(
        "--findings",
        type=int,
        default=5,
        help="a target with so many is left alone until they are mended [5]",
    )
    arguments = parser.parse_args(argv)
    unknown = set(arguments.target or ()) - set(TARGETS)
    if unknown:
        parser.error(f"--target {', '.join(sorted(unknown))} is not one of {', '.join(names)}")
    if find_spec("atheris") is None:
        parser.error("atheris is not installed: install the dependency group 'fuzz'")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    chosen = arguments.target or names
    try:
        for name in chosen:
            checked_seeds(TARGETS[name])
        rows = [
            _fuzzed(
                name,
                runs=runs,
                folder=arguments.folder,
                seed=arguments.seed,
                most_findings=arguments.findings,
            )
            for name, runs in shared(chosen, arguments.runs).items()
        ]
    except CannotStartError as error:
        print(f"fuzz: {error}", file=sys.stderr)
        return 2
    (arguments.folder / "summary.json").write_text(
        json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8"
    )
    Console(highlight=False, width=max(100, Console().width)).print(_table(rows))
    return int(any(row.findings for row in rows))


def shared(names: Sequence[str], runs: int) -> dict[str, int]:
    """How many inputs each target gets; together at least ``runs``."""
    shares = {name: max(1, TARGETS[name].share) for name in names}
    whole = sum(shares.values())
    return {name: math.ceil(runs * share / whole) for name, share in shares.items()}


def _fuzzed(name: str, *, runs: int, folder: Path, seed: int, most_findings: int) -> TargetResult:
    done, seconds, slowest_ms, growth_mb, findings = 0, 0.0, 0.0, 0.0, []
    coverage = corpus = 0
    while done < runs and len(findings) < most_findings:
        before = _artefacts(name, folder)
        log = _run_worker(name, runs=runs - done, folder=folder, seed=seed + len(findings))
        said = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        if said["broke"] == _NO_START:
            raise CannotStartError(f"target {name} does not run its first input: see {log}")
        done += said["inputs"]
        seconds += said["seconds"]
        slowest_ms = max(slowest_ms, said["slowest_ms"])
        growth_mb = max(growth_mb, _growth_mb(said["rss_kb"]))
        numbers = _COVERAGE.findall(log.read_bytes())
        if numbers:
            coverage, corpus = max(coverage, int(numbers[-1][0])), max(corpus, int(numbers[-1][1]))
        fresh = sorted(_artefacts(name, folder) - before)
        if fresh or said["inputs"] < runs - done + said["inputs"]:
            findings.append(f"{said['broke'] or 'ended early'} ({', '.join(fresh) or log})")
            print(f"{name}: {findings[-1]}", file=sys.stderr, flush=True)
    row = TargetResult(
        name, done, done / max(seconds, 1e-9), corpus, coverage, slowest_ms, growth_mb, tuple(findings)
    )
    print(
        f"{name}: {row.inputs} inputs, {row.inputs_per_s:.0f}/s, {row.growth_mb:+.1f} MB",
        file=sys.stderr,
        flush=True,
    )
    return row


def _run_worker(name: str, *, runs: int, folder: Path, seed: int) -> Path:
    """One process; its output goes to a file, of which the end is kept."""
    log = folder / f"{name}.log"
    (folder / f"{name}.json").write_text(
        json.dumps({"inputs": 0, "seconds": 0, "slowest_ms": 0, "rss_kb": [], "broke": _NO_START})
    )
    command = [sys.executable, "-m", "lab.fuzz.worker", name, "--runs", str(runs)]
    command += ["--folder", str(folder), "--seed", str(seed)]
    root = Path(__file__).parents[2]
    path = os.pathsep.join([str(root), str(root / "tests" / "support"), *sys.path])
    with log.open("wb") as out:
        # The messages of libjpeg on each picture go there too: a log of some megabytes at most.
        subprocess.run(
            command,
            stdout=out,
            stderr=out,
            env={**os.environ, "PYTHONPATH": path, "ASAN_OPTIONS": "detect_leaks=0"},
            check=False,
        )
    return log


def _artefacts(name: str, folder: Path) -> set[str]:
    found = folder / "found"
    return {str(one) for one in found.glob(f"{name}-*")} if found.is_dir() else set()


def _growth_mb(rss_kb: Sequence[tuple[int, int]]) -> float:
    if len(rss_kb) < 2:
        return 0.0
    last = rss_kb[-1]
    warm = next(one for one in rss_kb if one[0] >= _WARM * last[0])
    return (last[1] - warm[1]) / 1024


def _table(rows: Sequence[TargetResult]) -> Table:
    title = f"make fuzz: {sum(row.inputs for row in rows)} inputs"
    table = Table(title=title, title_justify="left")
    table.add_column("target")
    for name in ("inputs", "inputs/s", "corpus", "coverage", "slowest ms", "growth MB", "found"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            row.target,
            str(row.inputs),
            f"{row.inputs_per_s:.0f}",
            str(row.corpus),
            str(row.coverage),
            f"{row.slowest_ms:.1f}",
            f"{row.growth_mb:.1f}",
            str(len(row.findings)),
        )
    return table


if __name__ == "__main__":
    sys.exit(main())
