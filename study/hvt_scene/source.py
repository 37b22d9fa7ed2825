"""The drawn demo scene as a source of the edge, by the entry point ``demo`` in the group ``hvt.scenes``.

``demo:codes`` has codes painted on roofs, to be read; ``demo:4k`` has 3840x2160 pixels; ``demo:codes,4k`` both.

It is drawn in a process of its own, as a camera is a device of its own: its ground takes 170 MB, and a picture 30 ms,
beside the coding of the one before. At 4K that is 380 MB and 120 ms.
"""

from __future__ import annotations

import io
import math
import pickle
import signal
import subprocess
import sys
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hvt_common.errors import UserError
from hvt_common.units import exact_rate
from hvt_common.values import Frame, Image, Pose
from hvt_edge.source.contract import DrawnSource, SourceSettings
from hvt_edge.source.resample import Resizer, capture_time_ns
from hvt_scene.scene import Scene

_END_S = 5.0
_POSES_PER_S = 5
SCENE_WORDS: Mapping[str, tuple[str, Any]] = {"codes": ("codes", True), "4k": ("size", (3840, 2160))}
"""Words that may follow ``demo:``, each with its argument of the scene."""


def demo_scene(spec: str) -> dict[str, Any]:
    """The arguments of the scene's maker beside the seed, for ``demo`` or ``demo:WORD,…``; `UserError` for others."""
    _, colon, text = spec.partition(":")
    words = [word.strip() for word in text.split(",")] if colon else []
    for word in words:
        if word not in SCENE_WORDS:
            known = ", ".join(f"demo:{one}" for one in (*SCENE_WORDS, ",".join(SCENE_WORDS)))
            raise UserError(f"source {spec!r} has the unknown word {word!r}: accepted are demo, {known}")
    return dict(SCENE_WORDS[word] for word in words)


class DemoSource(DrawnSource):
    """The demo scene from its beginning to its end, at the base rate.

    The frame at ``index`` shows the scene at the moment ``index / fps``. Raises `UserError` where `demo_scene` does
    not accept ``spec``.
    """

    live = False

    def __init__(self, spec: str, settings: SourceSettings, *, seed: int) -> None:
        demo_scene(spec)  # names the fault here
        self._drawing = subprocess.Popen(  # noqa: S603 - our own module
            [sys.executable, "-m", __name__, str(seed), spec],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for this process, which then ends that one
        )
        self._end = weakref.finalize(self, _end, self._drawing)
        self._size: tuple[int, int]
        self._pictures_due = 0
        """Requested pictures that were not taken yet."""
        self._size, self.class_names, duration_s = self._answer()
        self.fps = settings.fps
        self._resizer = Resizer(self._size, settings.size, fit=settings.fit)
        self.view = self._resizer.view
        whole = math.ceil(duration_s * exact_rate(self.fps))
        self.frame_count = self._count = min(whole, settings.max_frames or whole)

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        rate = exact_rate(self.fps)
        self._drop_pictures()
        self._request("image", 0.0)
        for index in range(self._count):
            self._request("image", float((index + 1) / rate))  # drawn while this one is coded
            capture_ns = capture_time_ns(index, fps=rate, start_ns=start_ns)
            yield self._resizer.frame(self._picture(), index=index, capture_ns=capture_ns)
        self._drop_pictures()

    def write_truth(self, path: Path, *, fps: float) -> None:
        self._drop_pictures()
        self._request("truth", path, fps, self.view)
        self._answer()

    def poses(self) -> list[Pose]:
        self._request("poses")
        poses: list[Pose] = self._answer()
        return poses

    def close(self) -> None:
        """End the drawing; garbage collection of the source ends it too."""
        self._end()

    def _request(self, *request: Any) -> None:
        assert self._drawing.stdin is not None, "it was opened with a pipe"
        with _drawing_on():
            pickle.dump(request, self._drawing.stdin)
            self._drawing.stdin.flush()
        self._pictures_due += request[0] == "image"

    def _answer(self) -> Any:
        assert self._drawing.stdout is not None, "it was opened with a pipe"
        with _drawing_on():
            return pickle.load(self._drawing.stdout)  # noqa: S301 - our own process

    def _picture(self) -> Image:
        assert self._drawing.stdout is not None, "it was opened with a pipe"
        picture = np.empty((self._size[1], self._size[0], 3), np.uint8)
        with _drawing_on():
            if self._drawing.stdout.readinto(picture.data) != picture.nbytes:  # type: ignore[attr-defined]
                raise EOFError
        self._pictures_due -= 1
        return picture

    def _drop_pictures(self) -> None:
        while self._pictures_due:
            self._picture()


@contextmanager
def _drawing_on() -> Iterator[None]:
    try:
        yield
    except (EOFError, BrokenPipeError, pickle.UnpicklingError):
        raise UserError("--source demo: the process that draws the scene has ended") from None


def _end(drawing: subprocess.Popen[bytes]) -> None:
    drawing.kill()
    drawing.communicate(timeout=_END_S)


def _draw(seed: int, spec: str) -> None:
    scene = Scene(seed, **demo_scene(spec))
    # Not `sys.stdout.buffer`: with PYTHONUNBUFFERED it has no buffer, and a signal cuts its writes short.
    answers = io.BufferedWriter(io.FileIO(sys.stdout.fileno(), "w", closefd=False))
    requests = sys.stdin.buffer
    pickle.dump((scene.size, scene.class_names, scene.duration_s), answers)
    answers.flush()
    while True:
        try:
            kind, *rest = pickle.load(requests)  # noqa: S301 - from the process that started this one
        except EOFError:
            return
        if kind == "image":
            answers.write(scene.image(min(rest[0], scene.duration_s)).data)
        elif kind == "poses":
            count = math.ceil(scene.duration_s * _POSES_PER_S)
            pickle.dump([scene.pose(number / _POSES_PER_S) for number in range(count + 1)], answers)
        else:
            path, fps, view = rest
            scene.write_truth(path, fps=fps, view=view)
            pickle.dump(None, answers)
        answers.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # whoever asked was killed: that is the end, and no fault
    _draw(int(sys.argv[1]), sys.argv[2])
