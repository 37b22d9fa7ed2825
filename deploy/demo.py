"""The demo: edge and ground as two processes over Zenoh on the drawn scene, with and without stills.

The link is a thin radio of 250 kbps. M0 spends all of it on video; the hybrid run spends two fifths on stills. Writes
demo.rrd (the hybrid run), and prints both summaries and what each run knew of the scene on every frame, against its
exact ground truth.
"""

from __future__ import annotations

import argparse
import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

BIN = Path(sys.executable).parent
FOLDER = Path("build/demo")


def main(argv: Sequence[str] | None = None) -> int:
    """Run M0 and the hybrid method one after the other; 0 when both went well."""
    arguments = _arguments(argv)
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    hybrid = arguments.method
    for method, share in (("M0", "1"), (hybrid, arguments.video_share)):
        print(f"\n{method}: 20 s of the scene at {arguments.budget} in all", flush=True)
        code = _run(method, share, arguments)
        if code:
            print(f"demo: {method} ended with code {code}", file=sys.stderr)
            return code
    shutil.copyfile(FOLDER / f"{hybrid}.rrd", arguments.out)
    tables = [f"{method}={FOLDER / f'{method}.csv'}" for method in ("M0", hybrid)]
    truth = ["--truth", FOLDER / "truth.txt", "--size", arguments.size]
    print(flush=True)
    subprocess.run([BIN / "hvt-study", "score", *tables, *truth], check=True)
    print(f"\nopen the recording: {BIN / 'rerun'} {arguments.out}")
    return 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--method", default="M5", help="the hybrid method")
    add("--budget", default="250kbps", help="bits a second in all, for both runs")
    add("--video-share", default="0.6", help="of the hybrid run; M0 takes all")
    add("--size", default="640x360", help="of the base stream; the scene is drawn in 1920x1080")
    add("--seed", default="0", help="of the scene")
    add("--pace", default="lockstep", help="lockstep drops nothing on a slow machine; realtime shows latency")
    add("--out", type=Path, default=Path("demo.rrd"), help="the recording")
    return parser.parse_args(argv)


def _run(method: str, share: str, arguments: argparse.Namespace) -> int:
    """One edge and one ground, two processes."""
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    ground = {
        "--listen": endpoint,
        "--wait": "60s",
        "--refine": "fuse",
        "--record": FOLDER / f"{method}.rrd",
        "--tracks": FOLDER / f"{method}.csv",
        "--summary": FOLDER / f"{method}-ground.json",
    }
    edge = {
        "--source": "demo",
        "--seed": arguments.seed,
        "--edge-id": "demo",
        "--connect": endpoint,
        "--method": method,
        "--budget": arguments.budget,
        "--video-share": share,
        "--size": arguments.size,
        "--pace": arguments.pace,
        "--truth": FOLDER / "truth.txt",
        "--summary": FOLDER / f"{method}-edge.json",
    }
    listening = subprocess.Popen([BIN / "hvt-ground", "--once", *_flags(ground)])
    try:
        code = subprocess.run([BIN / "hvt-edge", *_flags(edge)], check=False).returncode
        return code or listening.wait(timeout=30)
    finally:
        if listening.poll() is None:
            listening.terminate()
            listening.wait(timeout=10)


def _flags(settings: dict[str, str | Path]) -> list[str | Path]:
    return [word for setting in settings.items() for word in setting]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    sys.exit(main())
