"""The demo: edge and ground as two processes over Zenoh on the drawn scene, with and without stills.

Writes demo.rrd (the hybrid run), and prints both summaries and what each run knew of the scene, against its exact
ground truth, at the same total budget.
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--method", default="M5", help="the hybrid method")
    parser.add_argument("--budget", default="800kbps", help="bits a second in all, for both runs")
    parser.add_argument("--seed", default="0", help="of the scene")
    parser.add_argument(
        "--pace",
        default="lockstep",
        help="lockstep drops nothing on a slow machine; realtime shows latency too",
    )
    parser.add_argument("--out", type=Path, default=Path("demo.rrd"), help="the recording")
    arguments = parser.parse_args(argv)
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    for method in ("M0", arguments.method):
        print(f"\n{method}: the scene of 20 s at {arguments.budget} in all", flush=True)
        code = _run(method, budget=arguments.budget, seed=arguments.seed, pace=arguments.pace)
        if code:
            print(f"demo: {method} ended with code {code}", file=sys.stderr)
            return code
    shutil.copyfile(FOLDER / f"{arguments.method}.rrd", arguments.out)
    tables = [f"{method}={FOLDER / f'{method}.csv'}" for method in ("M0", arguments.method)]
    print(flush=True)
    subprocess.run([BIN / "hvt-study", "score", *tables, "--truth", FOLDER / "truth.txt"], check=True)
    print(f"\nopen the recording: {BIN / 'rerun'} {arguments.out}")
    return 0


def _run(method: str, *, budget: str, seed: str, pace: str) -> int:
    """One edge and one ground, two processes."""
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    record, tracks = FOLDER / f"{method}.rrd", FOLDER / f"{method}.csv"
    ground = subprocess.Popen(
        [
            BIN / "hvt-ground",
            "--listen",
            endpoint,
            "--once",
            "--wait",
            "60s",
            "--record",
            record,
            "--tracks",
            tracks,
        ]
    )
    edge = [BIN / "hvt-edge", "--source", "demo", "--seed", seed, "--edge-id", "demo", "--connect", endpoint]
    edge += ["--method", method, "--budget", budget, "--pace", pace, "--truth", FOLDER / "truth.txt"]
    try:
        code = subprocess.run(edge, check=False).returncode
        return code or ground.wait(timeout=30)
    finally:
        if ground.poll() is None:
            ground.terminate()
            ground.wait(timeout=10)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    sys.exit(main())
