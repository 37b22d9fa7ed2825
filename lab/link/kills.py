"""``kill -9`` of edge or ground at random moments of short flights: the files must be readable, and nearly whole.

``PYTHONPATH=.:tests/support python -m lab.link.kills --count 50 --seed 0``. Each flight goes over a link that comes
and goes (`kills.toml`); one kill in five falls into the ending, when files are closed. Ctrl-C ends the other side,
which must end well. The files of both sides are compared with ``hvt-ground --timing``, and for the store by the time
of the last frame in it.
"""

import argparse
import concurrent.futures
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import av
from rich.console import Console

from hvt_common.errors import exit_with_sentence
from hvt_common.video.hevc import BaseDecoder
from lab.link.carriers.relay import Relay
from lab.link.measures.rows import row, save, table
from lab.link.measures.store_left import StoreLeft, store_left
from lab.link.measures.timing import Arrival, read_timing
from lab.link.script import load_scenario
from lab.link.started import Started
from media.pictures import write_scene
from programs.processes import eventually, free_ports
from programs.rrd import Recording

Victim = Literal["edge", "ground"]

FPS = 10
EDGE = f"--source-fps {FPS} --fps {FPS} --size 320x180 --preset ultrafast --detector motion --budget 400kbps".split()
GROUND = ("--detector", "motion", "--classifier", "none")
FRAMES = 180
"""Frames of the scene: longer than any trial."""
_SCRIPT = Path(__file__).with_name("kills.toml")
_FLIGHT_S = (0.1, 7.5)
_ENDING_S = (0.0, 0.25)
_TAKES_IN_S = 0.5

BARS = {
    "recordings unreadable": "== 0",
    "Matroska files unreadable": "== 0",
    "missing from a recording at most, s": "<= 0.3",
    "missing from a Matroska file at most, s": "<= 0.3",
    "objects in a store unreadable": "== 0",
    "missing from a store at most, s": "<= 0.3",
    "survivors that did not end well": "== 0",
    "kills": ">= 1",
}


@dataclass(frozen=True, slots=True)
class Trial:
    """One kill."""

    number: int
    victim: Victim
    after_s: float
    """From the ground's first frame on."""
    ending_s: float | None
    """So long before the kill it was arguments to end; None where it was not."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The files after one kill."""

    trial: Trial
    frames: int
    """That the ground had shown."""
    recording_missing_s: float | None
    """Seconds of shown video from the first missing frame on; None where the file cannot be read."""
    matroska_missing_s: float | None
    """Seconds of the received video."""
    matroska_behind_kill_s: float
    """From the last frame in it to the kill; the time to encode, and frames that were given up, are in it."""
    ended: bool
    """It had ended by itself, before the kill."""
    store: StoreLeft
    """The store of the edge."""
    survivor: int | None
    """Exit code of the other side; None where it had to be killed."""
    said: str = field(default="", repr=False)


def plan(count: int, *, seed: int) -> list[Trial]:
    """The kills: both sides in turn, moments from the seed."""
    drawn = random.Random(f"kills-{seed}")
    return [
        Trial(
            number=number,
            victim=("edge", "ground")[number % 2],
            after_s=drawn.uniform(*_FLIGHT_S),
            ending_s=drawn.uniform(*_ENDING_S) if number % 5 == 3 else None,
        )
        for number in range(count)
    ]


def run_all(trials: Sequence[Trial], folder: Path, *, at_once: int = 2) -> list[Verdict]:
    """Run them, some at a time; every trial leaves its files in a folder of its number."""
    scene = folder / "scene"
    if not scene.exists():
        scene.mkdir(parents=True)
        write_scene(scene, frames=FRAMES)
    with concurrent.futures.ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(lambda one: run_trial(one, scene, folder / f"{one.number:03d}"), trials))


def run_trial(trial: Trial, scene: Path, folder: Path) -> Verdict:
    """One flight, one kill; nothing is left running.

    Raises:
        AssertionError: edge or ground did not come up.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder)
    folder.mkdir()
    timing, recording, matroska = (folder / name for name in ("timing.csv", "run.rrd", "base.mkv"))
    script = load_scenario(_SCRIPT).script("short", seed=trial.number)
    with ExitStack() as stack:
        (port,) = free_ports(1)
        link = stack.enter_context(Relay(script, target_port=port, seed=trial.number))
        ground = stack.enter_context(Started("ground", folder, [
            sys.executable, "-m", "hvt_ground.cli", "--listen", f"tcp/127.0.0.1:{port}", "--timing", str(timing),
            "--record", str(recording), *GROUND,
        ]))  # fmt: skip
        ground.until("listening on")
        edge = stack.enter_context(Started("edge", folder, [
            sys.executable, "-m", "hvt_edge.cli", "--connect", f"tcp/127.0.0.1:{link.port}", "--wait", "60s",
            "--source", str(scene), "--record-base", str(matroska), "--store-folder", str(folder / "store"), *EDGE,
        ]))  # fmt: skip
        # On a busy machine a ground takes a second to open its recording, and a kill before that tells nothing.
        eventually(
            lambda: read_timing(timing) and recording.exists() and in_recording(recording),
            what="a first frame is in the ground's recording",
        )
        link.begin()
        time.sleep(trial.after_s)
        victim, survivor = (edge, ground) if trial.victim == "edge" else (ground, edge)
        if trial.ending_s is not None:
            victim.process.send_signal(signal.SIGINT)
            time.sleep(trial.ending_s)
        ended, kill_s = not victim.alive, time.time()
        victim.kill()
        time.sleep(_TAKES_IN_S)
        code = survivor.end()
    return _judged(trial, folder, ended=ended, kill_s=kill_s, survivor=code, said=edge.said + ground.said)


def _judged(
    trial: Trial, folder: Path, *, ended: bool, kill_s: float, survivor: int | None, said: str
) -> Verdict:
    frames = [one for one in read_timing(folder / "timing.csv") if one.kind == "base"]
    shown = [one for one in frames if one.shown]
    recorded = in_recording(folder / "run.rrd")
    times_s = in_matroska(folder / "base.mkv")
    # The file counts from its first frame, which is the flight's.
    matroska_s = None if times_s is None else [frames[0].capture_s + one for one in times_s]
    return Verdict(
        trial=trial,
        frames=len(shown),
        recording_missing_s=None if recorded is None else missing_s(shown, recorded),
        matroska_missing_s=None if matroska_s is None else missing_s(frames, matroska_s),
        matroska_behind_kill_s=kill_s - max(matroska_s) if matroska_s else 0.0,
        ended=ended,
        store=store_left(folder / "store"),
        survivor=survivor,
        said=said,
    )


def missing_s(wanted: Sequence[Arrival], there_s: Sequence[float]) -> float:
    """Capture time from the first of the wanted frames that is not there to the last one's end; 0 of none."""
    there = {round(100 * at_s) for at_s in there_s}  # hundredths: frames are a tenth apart
    # Matroska counts in milliseconds, so a capture time may fall into the hundredth beside.
    gone = [
        one.capture_s for one in wanted if not {round(100 * one.capture_s) + d for d in (-1, 0, 1)} & there
    ]
    return 0.0 if not gone else max(one.capture_s for one in wanted) - min(gone) + 1 / FPS


def in_recording(path: Path) -> list[float] | None:
    """Capture times of the recorded frames, seconds; None where it cannot be read or one of them not decoded."""
    try:
        video = Recording(path).video()
    except Exception as error:  # noqa: BLE001 - whatever the reader raises, the recording is not readable
        print(f"{path}: {error}", file=sys.stderr)
        return None
    decoder = BaseDecoder()
    if not video or any(decoder.decode(data) is None for _, _, data in video):
        return None
    return [capture_ns / 1e9 for _, capture_ns, _ in video]


def in_matroska(path: Path) -> list[float] | None:
    """Times of the frames that a player shows, in seconds from the first; None where it shows none."""
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            times = [float(frame.pts * frame.time_base) for frame in container.decode(stream)]
    except (av.FFmpegError, IndexError, OSError) as error:
        print(f"{path}: {error}", file=sys.stderr)
        return None
    return times or None


def rows_of(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    real = [one for one in verdicts if not one.ended]
    recording = [one.recording_missing_s for one in verdicts if one.recording_missing_s is not None]
    matroska = [one.matroska_missing_s for one in verdicts if one.matroska_missing_s is not None]
    stores = [one.store for one in verdicts]
    found: dict[str, float | int | None] = {
        "kills": len(real),
        "kills of the edge": sum(one.trial.victim == "edge" for one in real),
        "kills while ending": sum(one.trial.ending_s is not None for one in real),
        "recordings unreadable": sum(one.recording_missing_s is None for one in verdicts),
        "missing from a recording at most, s": max(recording, default=None),
        "Matroska files unreadable": sum(one.matroska_missing_s is None for one in verdicts),
        "missing from a Matroska file at most, s": max(matroska, default=None),
        "from the last frame in a Matroska file to the kill at most, s": max(
            (
                one.matroska_behind_kill_s
                for one in real
                if one.trial.victim == "edge" and one.trial.ending_s is None
            ),
            default=None,
        ),
        "kills that left something in a store": sum(
            one.store.objects > 0 for one in real if one.trial.victim == "edge"
        ),
        "objects in a store unreadable": sum(one.unreadable for one in stores),
        "missing from a store at most, s": max((one.missing_s for one in stores), default=None),
        "survivors that did not end well": sum(
            one.survivor != 0 or "Traceback" in one.said for one in verdicts
        ),
    }
    return [row("kill -9", name, value, BARS.get(name)) for name, value in found.items()]


def main(argv: Sequence[str] | None = None) -> int:
    """``make kills``; 1 where a bar does not hold and ``--strict`` is given."""
    return exit_with_sentence(_run, program="link.kills", argv=argv)


def _run(argv: Sequence[str] | None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--at-once", type=int, default=2)
    parser.add_argument("--only", type=int, help="one trial of these, by its number")
    parser.add_argument(
        "--keep", dest="folder", type=Path, metavar="DIR", help="folder to leave the files of every trial in"
    )
    parser.add_argument("--json", type=Path, default=Path("build/kills.json"))
    parser.add_argument("--strict", action="store_true", help="exit code 1 where a bar does not hold")
    arguments = parser.parse_args(argv)
    trials = [
        one for one in plan(arguments.count, seed=arguments.seed) if arguments.only in (None, one.number)
    ]
    with tempfile.TemporaryDirectory() as scratch:
        verdicts = run_all(trials, arguments.folder or Path(scratch), at_once=arguments.at_once)
    console = Console(highlight=False)
    for one in verdicts:
        if None in (one.recording_missing_s, one.matroska_missing_s) or one.survivor != 0:
            console.print(one, one.said)
    found = rows_of(verdicts)
    console.print(table(found, title="kill -9"))
    save(found, arguments.json)
    return int(arguments.strict and any(one["holds"] is False for one in found))


if __name__ == "__main__":
    sys.exit(main())
