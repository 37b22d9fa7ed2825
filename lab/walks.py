"""How many of the project's files a frame, a still and a command enter, on both sides of a real link in one process.

Who follows one of them by reading opens so many files. Codecs of stills are not counted: each is a room of its own.
The flight lasts until the command has reached the encoder and some stills have gone, however busy the machine is.
"""

import socket
import sys
import tempfile
import threading
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from hvt_common.config import load
from hvt_common.runtime.process import leave
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_edge.link.publisher import EdgeListener
from hvt_fleet import commands
from hvt_ground.app import Ground
from hvt_ground.extras import checked, config_class

_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("hvt_common", "hvt_edge", "hvt_ground", "hvt_fleet")
_CODECS = "hvt_common/video/still_codecs"
_FIRST_FRAMES, _LEAST_FRAMES, _LEAST_STILLS = 10, 60, 6
_MOST_S = 100.0

# Functions: name and bound of their walk, the largest of each taken together.
_WALKS = {
    ("RealtimePace.send",): ("a frame at the edge, from the loop to put, with an encoder that is opened", 20),
    ("StillStage.analyze",): ("a frame's objects at the edge", 25),
    ("StillStage.send",): ("a still at the edge, from choosing to put", 26),
    ("commands.run", "EdgeListener._on_control", "BaseStage._at_keyframe"): (
        "a command, from hvt-ground set-budget to the encoder",
        32,
    ),
    ("EdgeSessions.handle",): ("a message at the ground, received", 34),
    ("SessionPerception.pipeline",): ("a session's perception at the ground, made", 26),
    ("Pipeline.analyze",): ("a frame at the ground, analyzed", 27),
    ("Recorder.log",): ("an event at the ground, recorded and written", 12),
}
_MEASURED = {one for functions in _WALKS for one in functions}
_GOES, _KEYFRAME = "Transmitter.still", "BaseStage._at_keyframe"


class Walks:
    """Takes the events of `sys.setprofile`, of every thread that begins from now on."""

    def __init__(self) -> None:
        self.largest: dict[str, set[str]] = defaultdict(set)
        self.calls = Counter[str]()
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
        what = what if "." in what else f"{Path(name).stem}.{what}"
        if event == "call":
            self.calls[what] += 1
            if what in _MEASURED:
                walks.append((frame, what, set()))
            for _, _, files in walks:
                if not file.startswith(_CODECS):
                    files.add(file)
        elif walks and walks[-1][0] is frame:
            _, _, files = walks.pop()
            self.largest[what] = max(self.largest[what], files, key=len)

    def profiled(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, for threads that Python has not begun."""

        def call(*given: object) -> object:
            sys.setprofile(self.profile)
            try:
                return function(*given)
            finally:
                sys.setprofile(None)

        return call


def fly(walks: Walks) -> None:
    """Edge and ground at their defaults, over Zenoh on this machine; the demo scene, and one command."""
    threading.setprofile(walks.profile)
    EdgeListener._on_control = walks.profiled(EdgeListener._on_control)  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        words = ["--listen", endpoint, "--record", f"{folder}/a.rrd", "--once", "--quiet", "--wait", "300s"]
        ground_config, _ = load(config_class(), words, program="hvt-ground", description="")
        words = ["--source", "demo", "--budget", "400kbps", "--quiet"]
        words += ["--connect", endpoint, "--wait", "60s", "--fps", "5"]
        edge_config, given = load(EdgeConfig, words, program="hvt-edge", description="")
        edge_config = check(with_profile(edge_config, given=given.values))
        stop, landed = threading.Event(), threading.Event()
        ground = threading.Thread(target=Ground(checked(ground_config), stop=stop).run)
        edge = threading.Thread(target=Edge(edge_config, stop=landed).run)
        words = ["set-budget", "300kbps", "--connect", endpoint]
        for one in (ground, edge):
            one.start()
        wait = partial(_wait_for, walks, edge)
        wait({"RealtimePace.send": _FIRST_FRAMES})
        while edge.is_alive() and not walks.calls["EdgeListener._on_control"]:
            commander = threading.Thread(target=commands.run, args=[words])
            commander.start()
            commander.join(_MOST_S)
        wait({_KEYFRAME: walks.calls[_KEYFRAME] + 1})
        wait({"RealtimePace.send": _LEAST_FRAMES, _GOES: _LEAST_STILLS})
        for one, end in ((edge, landed), (ground, stop)):
            end.set()
            one.join(60)
    threading.setprofile(None)


def _wait_for(walks: Walks, edge: threading.Thread, least: dict[str, int]) -> None:
    # Until there were so many calls, or the clip has ended.
    while edge.is_alive() and any(walks.calls[what] < count for what, count in least.items()):
        edge.join(0.1)


def main() -> int:
    """Print each walk; 1 where one is longer than its bound."""
    walks = Walks()
    fly(walks)
    missed = 0
    for functions, (name, bound) in _WALKS.items():
        files = {file for one in functions for file in walks.largest[one]}
        bad = not all(walks.largest[one] for one in functions) or len(files) > bound
        missed += bad
        print(
            f"{'MISSED ' if bad else ''}{name} ({', '.join(functions)}): {len(files)} files, at most {bound}"
        )
        if bad:
            print("   ", *sorted(files))
    return 1 if missed else 0


if __name__ == "__main__":
    leave(main())
