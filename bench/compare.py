"""``make bench-compare``: every method at every rate on a real clip and on small objects, judged against the goals.

Writes build/compare/CLIP.json and CLIP.png.
``python -m bench.compare [CLIP …]``: carpark, highway (reference labels), street (exact labels), or all.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from bench.support.material import data
from hvt_common.runtime.reporting import write_json
from hvt_study.commands.compare import print_result
from hvt_study.matrix.compare import ComparePlan, CompareResult, CompareRow, compare
from hvt_study.matrix.pools import local_pool
from hvt_study.report.data.pairs import needed_bps
from hvt_study.report.figures.drawing import plot
from hvt_study.runs.spec import ModelChoice

_RATES = (150_000, 200_000, 300_000, 400_000, 800_000)
_CLIPS = {
    "carpark": "clips/drone_carpark.mp4",
    "highway": "still:aerial_highway.jpg",
    "street": "still:visdrone/0000001_02999_d_0000005.jpg@1.2",
}
_OUT = Path("build/compare")

Goal = tuple[str, str, bool | None]
"""The goal, the measure, and whether it holds; None where it cannot be judged."""


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.compare", description=__doc__)
    parser.add_argument("clips", nargs="*", metavar="CLIP", help=", ".join(_CLIPS))
    arguments = parser.parse_args(argv)
    unknown = [name for name in arguments.clips if name not in _CLIPS]
    if unknown:
        parser.error(f"clip {unknown[0]} is not known: choose from {', '.join(_CLIPS)}")
    _OUT.mkdir(parents=True, exist_ok=True)
    console = Console(highlight=False)
    for name in arguments.clips or _CLIPS:
        result = _fly(name)
        print_result(result)
        for goal, measured, holds in _goals(name, result):
            console.print(f"{_WORDS[holds]:>15}  {goal}: {measured}", markup=False, soft_wrap=True)
    return 0


_WORDS = {True: "holds", False: "does not hold", None: "not judged"}


def _fly(name: str) -> CompareResult:
    clip, models = _CLIPS[name], data() / "models"
    scheme, _, path = clip.rpartition(":")
    began_s = time.monotonic()
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(name, total=None)

        def on_run(done: int, of: int, *_: object) -> None:
            progress.update(task, completed=done, total=of)

        plan = ComparePlan(
            clip=f"{scheme}:{data() / path}" if scheme else str(data() / path),
            models=ModelChoice(
                detector=str(models / "yolov5su_visdrone_736x1280.onnx"),
                edge_detector=str(models / "yolov5su_visdrone_640.onnx"),
            ),
            rates_bps=_RATES,
            cache=(_OUT / "cache").absolute(),
        )
        with local_pool(os.cpu_count() or 1) as pool:
            result = compare(plan, pool=pool, on_run=on_run)
    print(f"{name}: {time.monotonic() - began_s:.0f} s", file=sys.stderr)
    write_json(_OUT / f"{name}.json", list(result.rows))
    plot(result, _OUT / f"{name}.png")
    return result


# Goals


def _goals(name: str, result: CompareResult) -> Iterator[Goal]:
    """All are of the second half, in which every track has had its turn."""
    rows = {(row["method"], row["rate_kbps"]): row for row in result.rows if row["half"] == 2}
    if name == "carpark":
        yield from _half_the_bits(rows)
    else:
        yield from _small_objects(rows)
    yield _never_worse(rows)


def _half_the_bits(rows: dict[tuple[str, float], CompareRow]) -> Iterator[Goal]:
    for rate in (300.0, 400.0, 800.0):  # half of less lies below the lowest rate
        goal = f"M6 needs at most 0.5 of the bits of M0-fps at {rate:g} kbps for its class agreement"
        row = rows.get(("M0-fps", rate))
        points = [(one["total_bps"], one["class_agreement"]) for one in _curve(rows, "M6")]
        if row is None or len(points) < 2:
            yield goal, "a method is missing", None
            continue
        needed = max(needed_bps(points, level=row["class_agreement"]), points[0][0])
        if math.isinf(needed):
            best = max(agreement for _, agreement in points)
            yield goal, f"M6 never reaches {row['class_agreement']:.3f} (best {best:.3f})", False
        else:
            share = needed / row["total_bps"]
            yield goal, f"{share:.2f} for {row['class_agreement']:.3f}", share <= 0.5


def _small_objects(rows: dict[tuple[str, float], CompareRow]) -> Iterator[Goal]:
    best = rows.get(("M6", 200.0))
    for other, factor in (("M0", 5.0), ("M0-fps", 1.5)):
        row = rows.get((other, 200.0))
        goal = f"F1 of M6 at 200 kbps at least {factor:g} x that of {other}"
        if best is None or row is None:
            yield goal, "a method is missing", None
            continue
        yield (
            goal,
            f"{best['f1']:.3f} / {row['f1']:.3f} = {best['f1'] / max(row['f1'], 1e-9):.2f}",
            best["f1"] >= factor * row["f1"],
        )
        goal = f"delay p95 of M6 at 200 kbps no worse than {other}'s"
        delays = best["delay_p95_ms"], row["delay_p95_ms"]
        if None in delays:
            yield goal, "no frame arrived", None
        else:
            yield goal, "{:.0f} and {:.0f} ms".format(*delays), delays[0] <= delays[1]


def _never_worse(rows: dict[tuple[str, float], CompareRow]) -> Goal:
    """At the bits that R0 really spent, M6's curve in between its rates."""
    goal = "M6 never worse than R0 at equal bits (F1 and class agreement)"
    mine, theirs = _curve(rows, "M6"), _curve(rows, "R0")
    if len(mine) < 2 or not theirs:
        return goal, "a method is missing", None
    gains: list[tuple[float, str, float]] = []
    for row in theirs:
        for measure in ("f1", "class_agreement"):
            value = _value_at(row["total_bps"], mine, measure)
            if value is not None:
                gains.append((value - row[measure], measure, row["rate_kbps"]))
    least, measure, rate = min(gains)
    return goal, f"least gain {least:+.3f} ({measure} at {rate:g} kbps)", least >= 0


def _curve(rows: dict[tuple[str, float], CompareRow], method: str) -> list[CompareRow]:
    return sorted(
        (row for (name, _), row in rows.items() if name == method), key=lambda row: row["total_bps"]
    )


def _value_at(bps: float, curve: list[CompareRow], measure: str) -> float | None:
    """A measure of a curve at so many bits; None below its beginning, its last value beyond its end."""
    totals = [row["total_bps"] for row in curve]
    if bps <= 0.97 * totals[0]:
        return None
    return float(np.interp(math.log(bps), np.log(totals), [row[measure] for row in curve]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
