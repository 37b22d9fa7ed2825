"""``make failures``: a flight of the demo scene loses disk, model, viewer and link, one by one, and gets each back.

Edge and ground are two processes, as a user starts them, over the laboratory's relay. Their output is printed at
once, each loss and each return between. At the end stand both tables, and rows with the cost of each loss. Losing
the disk needs the right to mount; without it that loss is left out, with the reason.
"""

import argparse
import contextlib
import math
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
from rich.console import Console

from lab.link.carriers.relay import Relay
from lab.link.material import demo_clip, looped
from lab.link.measures.rows import row, save, table
from lab.link.measures.timing import read_timing
from lab.link.timeline import LinkState, Phase, Script
from media.third_party import install
from programs.processes import Link, Running, eventually
from programs.small_disk import small_disk

BUILD = Path("build")
_CALM_S, _LOST_S, _FLIES_S = 12.0, 15.0, 10.0
"""Before the first loss, of each loss, and after each return."""
_SOON_S, _AGAIN_S = 30.0, 90.0
_LEAST_FPS = ">= 4"
"""Frames a second that an edge codes of a clip on any machine."""
_STATUS = re.compile(r"^demo:? +[0-9.]+ s ")
_LIGHT = LinkState(rate_bps=2_000_000, delay_s=0.02)
_BALLAST, _TIMING = "ballast", "timing.csv"
_MODEL = """
from pathlib import Path

from hvt_common.inference.detect import open_detector


class Removable:
    def __init__(self, removed):
        self.removed, self.inner = Path(removed), open_detector("aerial-nano")
        self.class_names = self.inner.class_names

    def detect(self, image_bgr):
        if self.removed.exists():
            raise RuntimeError("the model was taken away")
        return self.inner.detect(image_bgr)
"""


@dataclass(frozen=True)
class Loss:
    """One part, and how it goes and comes back."""

    part: str
    said: Sequence[tuple[str, str]]
    """(edge or ground, its sentence), each of which is waited for."""
    take: Callable[[], object]
    give: Callable[[], object] = lambda: None
    video: bool = True
    """Whether video is to go on meanwhile."""


class Flight:
    """The two processes, and a printer of their output; rows with the cost of each loss."""

    def __init__(self, edge: Running, ground: Running, *, folder: Path, console: Console) -> None:
        self.sides = {"edge": edge, "ground": ground}
        self.rows: list[dict[str, Any]] = []
        self._folder, self._console = folder, console
        self._printed = dict.fromkeys(self.sides, 0)
        self._began_s = time.monotonic()

    def lose(self, loss: Loss) -> None:
        """Take the part away, wait, give it back."""
        frames, began_s = self._frames(), time.time()
        self._say(f"{loss.part} is taken away")
        from_ = self._so_far()
        loss.take()
        named = self._named(loss.said, from_)
        self.watch(max(0.0, began_s + _LOST_S - time.time()))
        lasted_s, came = time.time() - began_s, self._frames() - frames
        self._say(f"{loss.part} is given back")
        from_ = self._so_far()
        given_s = time.monotonic()
        loss.give()
        again = self._all_well({name for name, _ in loss.said}, from_)
        again_s = time.monotonic() - given_s if again else math.inf
        frames = self._frames()
        self.watch(_FLIES_S)
        after = (self._frames() - frames) / _FLIES_S
        self._row(loss, "frames a second meanwhile", came / lasted_s, _LEAST_FPS if loss.video else None)
        self._row(loss, "named, of what should be", named / len(loss.said), "== 1")
        self._row(loss, "status is well again after, s", again_s, f"<= {_AGAIN_S:g}")
        self._row(loss, "frames a second afterwards", after, _LEAST_FPS)

    def watch(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self._print()
            time.sleep(0.2)

    def end(self) -> None:
        """Ctrl-C at the edge, then at the ground, and their tables."""
        self._say("Ctrl-C")
        for name, side in self.sides.items():
            side.stop()
            self._print()
            self._console.print((self._folder / f"{name}.out").read_text(), markup=False, soft_wrap=True)
            self.rows.append(row(name, "exit code", side.process.returncode, "== 0"))
            self.rows.append(row(name, "tracebacks", side.said.count("Traceback"), "== 0"))

    def _so_far(self) -> dict[str, int]:
        return {name: len(side.said) for name, side in self.sides.items()}

    def _named(self, said: Sequence[tuple[str, str]], from_: dict[str, int]) -> int:
        found: set[tuple[str, str]] = set()
        until_s = time.monotonic() + _SOON_S
        while len(found) < len(said) and time.monotonic() < until_s:
            found = {(name, text) for name, text in said if text in self.sides[name].said[from_[name] :]}
            self.watch(0.2)
        return len(found)

    def _all_well(self, names: set[str], from_: dict[str, int]) -> bool:
        """Wait for a status line of each of these in which nothing fails and no link is lost."""
        until_s = time.monotonic() + _AGAIN_S
        while time.monotonic() < until_s:
            self.watch(0.2)
            lines = [self.sides[name].said[from_[name] :].splitlines() for name in names]
            newest = [
                next((one for one in reversed(said) if _STATUS.search(one)), "FAILED") for said in lines
            ]
            if not any(bad in line for line in newest for bad in ("FAILED", "LOST", "no link", "no ground")):
                return True
        return False

    def _frames(self) -> int:
        return sum(one.kind == "base" and one.shown for one in read_timing(self._folder / _TIMING))

    def _row(self, loss: Loss, measure: str, value: float, bar: str | None) -> None:
        self.rows.append(row(loss.part, measure, value, bar))

    def _say(self, text: str) -> None:
        self._print()
        self._console.print(f"{time.monotonic() - self._began_s:6.1f} s  ---- {text} ----", markup=False)

    def _print(self) -> None:
        for name, side in self.sides.items():
            said = side.said
            whole = said[self._printed[name] : said.rfind("\n") + 1]
            self._printed[name] += len(whole)
            for line in whole.splitlines():
                text = f"{time.monotonic() - self._began_s:6.1f} s  {name:6} | {line}"
                self._console.print(text, markup=False, soft_wrap=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Fly; 1 where a part was not named, did not come back, or took the video with it."""
    parser = argparse.ArgumentParser(prog="python -m lab.failures", description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.parse_args(argv)
    console = Console(highlight=False)
    clip = demo_clip(BUILD / "link" / "demo.mp4")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hvt-failures-")))
        removed, disk = folder / "removed", folder / "disk"
        site = install(
            folder / "site",
            {"removable": "Removable"},
            module="removable",
            source=_MODEL,
            group="hvt.detectors",
        )
        os.environ["PYTHONPATH"] = f"{site}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        mounted = stack.enter_context(_disk(disk, console))
        link = stack.enter_context(Link(folder))
        dark = (
            Phase(0.0, _LIGHT),
            Phase(0.1, LinkState(rate_bps=2_000_000, dark=True)),
            Phase(_LOST_S, _LIGHT),
        )
        script = Script(phases=dark, lasts_s=600.0, queue_bytes=64_000)
        relay = stack.enter_context(Relay(script, target_port=link.port))
        model = ("--detector", f"removable:{removed}")
        ground = link.ground(
            *model, "--serve", "--record", f"{disk}/", "--tracks", str(disk), "--timing", _TIMING
        )
        source = looped(clip, folder / "clip.ffconcat", lasts_s=900)
        edge = link.start(
            "hvt_edge.cli",
            [
                *("--connect", f"tcp/127.0.0.1:{relay.port}", "--source", str(source), "--edge-id", "demo"),
                *(
                    "--size",
                    "640x360",
                    "--preset",
                    "ultrafast",
                    *model,
                    "--record-base",
                    str(disk / "base.mkv"),
                ),
                *("--store", "50MB", "--store-folder", str(folder / "store")),
            ],
            name="edge",
        )
        flight = Flight(edge, ground, folder=folder, console=console)
        eventually(lambda: read_timing(folder / _TIMING), what="video")
        flight.watch(_CALM_S)
        for loss in _losses(disk if mounted else None, removed=removed, ground=ground, relay=relay):
            flight.lose(loss)
        flight.end()
    console.print(table(flight.rows, title="a flight without its parts"))
    save(flight.rows, BUILD / "failures.json")
    return int(any(one["holds"] is False for one in flight.rows))


def _losses(disk: Path | None, *, removed: Path, ground: Running, relay: Relay) -> Iterator[Loss]:
    if disk is not None:
        yield Loss(
            "disk",
            said=[
                ("edge", "local copy: "),
                ("ground", "recording of demo: "),
                ("ground", "tracks table of demo: "),
            ],
            take=lambda: _fill(disk),
            give=(disk / _BALLAST).unlink,
        )
    yield Loss(
        "model",
        said=[("edge", "detector: "), ("ground", "detector: ")],
        take=removed.touch,
        give=removed.unlink,
    )
    yield Loss(
        "viewer",
        said=[("ground", "live view of demo: ")],
        take=lambda: _kill_viewer(ground),
    )
    yield Loss(
        "link",
        said=[("ground", "LINK LOST for"), ("edge", "kept ")],
        take=relay.begin,
        video=False,
    )


@contextmanager
def _disk(folder: Path, console: Console) -> Iterator[bool]:
    """A small disk at this folder; False where there is none, and it is a folder like any other."""
    with ExitStack() as stack:
        try:
            stack.enter_context(small_disk(folder, size="128m"))
        except pytest.skip.Exception as why:
            console.print(f"the disk is not taken away: {why}")
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            yield False
        else:
            yield True


def _fill(folder: Path) -> None:
    with (folder / _BALLAST).open("wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12):
            with contextlib.suppress(OSError):
                while file.write(bytes(size)) == size:
                    pass


def _kill_viewer(ground: Running) -> None:
    for child in psutil.Process(ground.process.pid).children():
        if any("--serve-web" in word for word in child.cmdline()):
            child.send_signal(signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
