"""How many of the project's files a frame and a still enter, on both sides of a real link in one process.

Who follows one of them by reading opens so many files. Codecs of stills are not counted: each is a room of its own.
On a busy machine no still may go; then its walk is shorter.
"""

from __future__ import annotations

import socket
import sys
import tempfile
import threading
from collections import defaultdict
from pathlib import Path
from types import FrameType

from hvt_common.config import load
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_ground.app import Ground
from hvt_ground.extras import checked, config_class

_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("hvt_common", "hvt_edge", "hvt_ground")
_CODECS = "hvt_common/video/still_codecs"
_FRAMES = 120

# Function: name and bound of its walk, the largest that is allowed.
_WALKS = {
    "RealtimePace.step": ("a frame at the edge, from the loop to put", 36),
    "StillStage.analyze": ("a frame's objects at the edge", 26),
    "StillStage.send": ("a still at the edge, from choosing to put", 44),
    "EdgeSessions.handle": ("a message at the ground, received", 72),
    "GroundSession._analyze": ("a frame at the ground, analyzed", 34),
    "Recorder.log": ("an event at the ground, recorded", 18),
}


class Walks:
    """Takes what `sys.setprofile` tells, of every thread that begins from now on."""

    def __init__(self) -> None:
        self.largest: dict[str, set[str]] = defaultdict(set)
        self._local = threading.local()

    def profile(self, frame: FrameType, event: str, _argument: object) -> None:
        """Note the file of a call for all walks that it is part of."""
        name = frame.f_code.co_filename
        place = next((name.find(f"/{one}/") for one in _PACKAGES if f"/{one}/" in name), -1)
        if (
            event not in ("call", "return")
            or place < 0
            or not name.startswith(str(_ROOT))
            or "/.venv/" in name
        ):
            return
        walks = self._local.__dict__.setdefault("walks", [])
        what, file = frame.f_code.co_qualname, name[place + 1 :]
        if event == "call":
            if what in _WALKS:
                walks.append((frame, what, set()))
            for _, _, files in walks:
                if not file.startswith(_CODECS):
                    files.add(file)
        elif walks and walks[-1][0] is frame:
            _, _, files = walks.pop()
            self.largest[what] = max(self.largest[what], files, key=len)


def fly(walks: Walks) -> None:
    """Edge and ground at their defaults, over Zenoh on this machine; the demo scene."""
    threading.setprofile(walks.profile)
    with tempfile.TemporaryDirectory() as folder:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        words = ["--listen", endpoint, "--record", f"{folder}/a.rrd", "--once", "--quiet", "--wait", "300s"]
        ground_config, _ = load(config_class(), words, program="hvt-ground", description="")
        words = ["--source", "demo", "--max-frames", str(_FRAMES), "--budget", "400kbps", "--quiet"]
        words += ["--connect", endpoint, "--wait", "60s", "--fps", "5"]
        edge_config, given = load(EdgeConfig, words, program="hvt-edge", description="")
        edge_config = check(with_profile(edge_config, given=given.values))
        stop = threading.Event()
        ground = threading.Thread(target=Ground(checked(ground_config), stop=stop).run)
        edge = threading.Thread(target=Edge(edge_config, stop=threading.Event()).run)
        for one in (ground, edge):
            one.start()
        edge.join(300)
        stop.set()
        ground.join(60)
    threading.setprofile(None)


def main() -> int:
    """Print each walk; 1 where one is longer than its bound."""
    walks = Walks()
    fly(walks)
    missed = 0
    for function, (name, bound) in _WALKS.items():
        files = walks.largest[function]
        bad = not 0 < len(files) <= bound
        missed += bad
        print(f"{'MISSED ' if bad else ''}{name} ({function}): {len(files)} files, at most {bound}")
        if bad:
            print("   ", *sorted(files))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
