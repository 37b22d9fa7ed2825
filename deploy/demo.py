"""The demo: three edges over a thin radio, and what the ground knew with each of them.

M0 spends all bits on video, ``paper`` a fifth on stills, ``auto`` sends what it measures to pay. Each edge is a
process with 250 kbps of its own; one ground serves all three. They see one drawn scene, whose truth is known exactly.
Ends with a table, a picture (demo.png) and a recording that opens on the comparison (demo.rrd).
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
EDGES = {"m0": ["--method", "M0"], "paper": ["--profile", "paper"], "auto": ["--profile", "auto"]}
_PROVIDER = "cpu"
"""``auto`` takes what is quicker at the start, which may be another in the next run: so would be the figures."""


def main(argv: Sequence[str] | None = None) -> int:
    """Fly all three at once, then compare them; 0 when all went well."""
    arguments = _arguments(argv)
    shutil.rmtree(FOLDER, ignore_errors=True)
    (FOLDER / "stills").mkdir(parents=True)
    print(f"{', '.join(EDGES)}: one scene, {arguments.budget} for each in all", flush=True)
    code = _fly(arguments)
    if code:
        print(f"demo: a process ended with code {code}: see {FOLDER}/*.log", file=sys.stderr)
        return code
    recordings = [next(FOLDER.glob(f"hvt-{name}-*.rrd")) for name in EDGES]
    join = [sys.executable, "-m", "hvt_archive.joined", *recordings, "--out", arguments.out]
    join += ["--size", arguments.size]
    subprocess.run(join, check=True)
    settings = {"--seed": arguments.seed, "--picture": arguments.picture}
    subprocess.run([BIN / "hvt-study", "demo", FOLDER, *EDGES, *_flags(settings)], check=True)
    print(f"the picture: {arguments.picture}\nthe recording: {BIN / 'rerun'} {arguments.out}")
    print(f"live in a browser: {BIN / 'hvt-ground'} --web & {BIN / 'hvt-edge'} --source demo:codes")
    print("  and open http://127.0.0.1:8080")
    return 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--budget", default="250kbps", help="bits a second in all, of each edge")
    add("--size", default="640x360", help="of the base stream; the scene is drawn in 1920x1080")
    add("--seed", default="0", help="of the scene")
    add("--pace", default="lockstep", help="lockstep drops nothing on a slow machine; realtime shows latency")
    add("--max-frames", help="the scene's first frames only, 15 a second")
    add("--out", type=Path, default=Path("demo.rrd"), help="the recording")
    add("--picture", type=Path, default=Path("demo.png"), help="the picture")
    return parser.parse_args(argv)


def _fly(arguments: argparse.Namespace) -> int:
    """Three edges and one ground, four processes."""
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    ground = {
        "--listen": endpoint,
        "--wait": "60s",
        "--record": FOLDER,
        "--tracks": FOLDER,
        "--stills": FOLDER / "stills",
        "--summary": FOLDER / "ground.json",
        "--provider": _PROVIDER,
    }
    shared = {
        "--source": "demo:codes",
        "--seed": arguments.seed,
        "--connect": endpoint,
        "--budget": arguments.budget,
        "--size": arguments.size,
        "--pace": arguments.pace,
        "--provider": _PROVIDER,
        **({"--max-frames": arguments.max_frames} if arguments.max_frames else {}),
    }
    listening = _started([BIN / "hvt-ground", "--once", "--quiet", *_flags(ground)], log="ground")
    flying = []
    try:
        for name, method in EDGES.items():
            own = {"--edge-id": name, "--summary": FOLDER / f"{name}-edge.json"}
            command = [BIN / "hvt-edge", "--quiet", *_flags(shared), *_flags(own), *method]
            flying.append(_started(command, log=name))
        codes = (one.wait() for one in flying)
        return next(filter(None, codes), 0) or listening.wait(timeout=90)
    finally:
        for one in (*flying, listening):
            if one.poll() is None:
                one.terminate()
                one.wait(timeout=10)


def _started(command: Sequence[str | Path], *, log: str) -> subprocess.Popen[bytes]:
    with (FOLDER / f"{log}.log").open("wb") as file:
        return subprocess.Popen(command, stdout=file, stderr=file)


def _flags(settings: dict[str, str | Path]) -> list[str | Path]:
    return [word for setting in settings.items() for word in setting]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    sys.exit(main())
