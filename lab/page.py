"""How old the picture on the page is, and how much viewers cost the ground: ``python -m lab.page``.

A flight over loopback and headless Chromium on this machine. Glass to glass: from capture to the picture's being
handed to the screen, both by this machine's clock. The further viewers read the same as a browser, and show nothing.
"""

import argparse
import json
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import psutil
from playwright.sync_api import sync_playwright
from websockets.sync.client import connect

from programs.processes import Link, Running, free_ports

_SETTLE_S = 6.0

_NOTE_AGES = """() => {
  window.ages = [];
  new MutationObserver(() => window.ages.push(Number(document.getElementById("age").dataset.ms)))
    .observe(document.getElementById("age"), { attributes: true, attributeFilter: ["data-frame"] });
}"""


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m lab.page", description=__doc__)
    parser.add_argument("source", help="what hvt-edge --source takes")
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--lasts", type=float, default=15.0, metavar="SECONDS", help="of each measurement")
    parser.add_argument("--viewers", type=int, nargs="*", default=[1, 20])
    arguments = parser.parse_args(argv)
    port = free_ports(1)[0]
    with Link(Path(tempfile.mkdtemp())) as link:
        ground = link.ground(
            *("--record", "page.rrd", "--detector", "motion", "--classifier", "none"),
            *("--web", f"127.0.0.1:{port}"),
        )
        link.edge(
            *("--source", arguments.source, "--size", arguments.size, "--budget", "800kbps"),
            *("--detector", "motion", "--profile", "paper", "--preset", "ultrafast", "--edge-id", "uav-1"),
        )
        time.sleep(_SETTLE_S)
        print(f"ground, nobody looks: {_cpu_pct(ground, arguments.lasts):.0f} % of a core")
        _glass_to_glass(port, arguments.lasts)
        for count in arguments.viewers:
            with ExitStack() as stack:
                for _ in range(count):
                    stack.enter_context(_Viewer(port))
                time.sleep(2)
                print(f"ground, {count} viewers: {_cpu_pct(ground, arguments.lasts):.0f} % of a core")
    return 0


def _cpu_pct(running: Running, lasts_s: float) -> float:
    process = psutil.Process(running.process.pid)
    process.cpu_percent()
    time.sleep(lasts_s)
    return float(process.cpu_percent())


def _glass_to_glass(port: int, lasts_s: float) -> None:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}/")
        time.sleep(4)
        page.evaluate(_NOTE_AGES)
        time.sleep(lasts_s)
        ages = sorted(page.evaluate("window.ages"))
        browser.close()
    parts = statistics.quantiles(ages, n=20)
    print(
        f"glass to glass: {len(ages)} pictures, p50 {parts[9]:.0f} ms, p95 {parts[18]:.0f} ms, max {ages[-1]} ms"
    )


class _Viewer(ExitStack):
    """Takes the coded stream of one edge in a process' thread of its own."""

    def __init__(self, port: int) -> None:
        super().__init__()
        self._port = port

    def __enter__(self) -> Self:
        where = f"127.0.0.1:{self._port}"
        socket = self.enter_context(
            connect(f"ws://{where}/ws", origin=f"http://{where}", max_queue=None)  # type: ignore[arg-type]
        )
        socket.send(json.dumps({"type": "wall", "shown": True}))
        socket.send(json.dumps({"type": "watch", "edge": "uav-1", "rung": "h264"}))
        return self


if __name__ == "__main__":
    sys.exit(main())
