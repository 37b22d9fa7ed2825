"""A picture of a recording's screen, without a screen: ``python -m hvt_archive.screenshot FILE.rrd``.

Needs the same as the viewer: a Vulkan driver (Mesa's software one will do; Debian: mesa-vulkan-drivers) and, for
HEVC, ``ffmpeg`` on the PATH (5.1 or later).
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from hvt_common.errors import UserError, exit_with_sentence, needs_extra
from hvt_common.runtime.reporting import check_writable
from hvt_common.units import parse_size

T = TypeVar("T")
_START_S, _SETTLE_S, _ANSWER_S = 30.0, 4.0, 120.0
_MENU_PX = 37


def screenshot(recording: Path, *, frame: int, out: Path, size: tuple[int, int] = (1920, 1080)) -> None:
    """Open ``recording`` (.rrd) in a headless viewer, go to ``frame`` of its timeline, and write its screen as PNG.

    ``size`` is the window's in pixels (the picture is lower by the menu bar); the viewer has four seconds to decode
    and lay out. Raises `UserError` where a file or a part that the viewer needs is missing, or the viewer does not
    start.
    """
    from hvt_archive.viewer import free_port, started_viewer  # noqa: PLC0415 - they need Rerun

    if not recording.is_file():
        raise UserError(f"recording {recording} does not exist: give an .rrd file")
    check_writable(out, name="--out", reads=[recording])
    if shutil.which("ffmpeg") is None:
        raise UserError("ffmpeg is not on the PATH: the viewer needs it to show HEVC")
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="hvt-viewer-") as runtime:
        process = started_viewer(
            ["--headless", "--hide-welcome-screen", "--window-size", f"{size[0]}x{size[1]}"],
            port=port,
            needs="a Vulkan driver, software will do",
            environment={"XDG_RUNTIME_DIR": runtime},
        )
        try:
            png = _picture(port, recording, frame=frame)
        except ConnectionError:
            raise UserError(
                f"the viewer ended while it drew {recording}; an emoji in a class's name is known to end it"
            ) from None
        finally:
            process.terminate()
            process.wait(timeout=10)
    out.write_bytes(_without_menu(png))


def _picture(port: int, recording: Path, *, frame: int) -> bytes:
    from rerun.experimental import ViewerClient  # noqa: PLC0415

    client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
    _answered(lambda: client.open(str(recording.resolve())))
    deadline = time.monotonic() + _START_S
    while not any(r.timelines for r in _answered(client.get_state).recordings):
        if time.monotonic() > deadline:
            raise UserError(f"recording {recording} holds nothing that the viewer can show")
        time.sleep(0.1)
    _answered(lambda: client.set_time("frame", sequence=frame, play_state="paused"))
    time.sleep(_SETTLE_S)
    return _answered(client.take_screenshot)


def _answered(ask: Callable[[], T]) -> T:
    # Rerun waits for some seconds; a busy machine without a graphics card may draw for longer.
    until_s = time.monotonic() + _ANSWER_S
    while True:
        try:
            return ask()
        except TimeoutError:
            if time.monotonic() > until_s:
                raise UserError(f"the viewer has not answered for {_ANSWER_S:g} s") from None


def _without_menu(png: bytes) -> bytes:
    # Cut the menu bar: it tells of the machine that took the picture (a software renderer, a container).
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise UserError("the headless viewer returned no picture")
    _, cropped = cv2.imencode(".png", picture[_MENU_PX:])
    return cropped.tobytes()


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="hvt_archive.screenshot", description="A picture of a recording's screen."
    )
    parser.add_argument("recording", type=Path, help="an .rrd file")
    parser.add_argument("--frame", type=int, default=0, help="value of the frame timeline (default 0)")
    parser.add_argument("--out", type=Path, required=True, help="the PNG to write")
    parser.add_argument("--size", default="1920x1080", help="window in pixels (default 1920x1080)")
    given = parser.parse_args(argv)
    size = parse_size(given.size, name="--size")
    with needs_extra("'hvt[ground]'"):
        screenshot(given.recording, frame=given.frame, out=given.out, size=size)
    return 0


if __name__ == "__main__":
    raise SystemExit(exit_with_sentence(main, program="hvt_archive.screenshot", argv=None))
