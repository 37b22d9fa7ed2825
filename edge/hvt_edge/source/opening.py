"""Opens the source: the first stage of the edge. One function opens every kind of source."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

from hvt_common.errors import FlightError, NotYetError, UserError, absent, named_path, not_installed
from hvt_common.redaction import HIDDEN, redacted
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.host_names import with_small_scheme
from hvt_common.runtime.plug_ins import loaded, the_one
from hvt_common.values import Fit
from hvt_edge.source.camera import CameraGrabber
from hvt_edge.source.contract import BaseSize, Source, SourceSettings, check_shape
from hvt_edge.source.decoding.container import is_local
from hvt_edge.source.folder import FolderSource, is_tiff
from hvt_edge.source.live import LiveSource, patience_s
from hvt_edge.source.stream import LIVE_SCHEMES, StreamGrabber, is_description
from hvt_edge.source.video import VideoSource

__all__ = ["Source", "check_shape", "open_source", "shown"]

_ACCEPTED = (
    "a video file, a folder of images, rtsp://…, rtmp://…, http://…, udp://…, FILE.sdp, /dev/videoN, demo or "
    "demo:codes,4k"
)
_PIPE = re.compile(r"-|(?:pipe|fd):.*|/dev/(?:stdin|fd/.*)|.*\s!\s.*", re.DOTALL)
"""Ways to write standard input, and a pipeline of GStreamer."""


class SourceKinds(NamedTuple):
    """The classes with which streams and clips are opened; ``--encoder passthrough`` has its own."""

    grabber: Callable[..., StreamGrabber]
    live: Callable[..., Source]
    clip: Callable[[str, SourceSettings], Source]


_DECODED = SourceKinds(StreamGrabber, LiveSource, VideoSource)


def open_source(
    spec: str,
    *,
    size: BaseSize,
    fps: float,
    fit: Fit = "letterbox",
    seed: int = 0,
    max_frames: int | None = None,
    source_fps: float | None = None,
    kinds: SourceKinds = _DECODED,
    growing: bool = False,
    clock: Callable[[], int] | None = None,
    failures: Failures | None = None,
) -> Source:
    """Open a source of base frames: a video file, an image folder, a stream's URL, a V4L2 device, or ``demo``.

    ``size`` is (width, height) of the base frames in pixels, even, 64…8192, or a function of the source's size;
    ``fps`` is above 0 and at most 240; for ``fit`` see `View.fitted`. ``source_fps`` is the rate at which the
    images of a folder were taken (default: the base rate), or overrides a video file's own time stamps. ``clock``
    is a live source's, Unix nanoseconds without steps, and ``failures`` records its outages; None for its own.
    A ``growing`` file is read while it grows.
    Raises `UserError` if nothing usable is there, or size or rate are impossible; `FlightError` if a disk may come.
    """
    check_shape(size=size, fps=fps, source_fps=source_fps)
    settings = SourceSettings(
        size=size, fps=fps, fit=fit, max_frames=max_frames, source_fps=source_fps, growing=growing
    )
    clock = clock or SteadyClock()
    if is_demo(spec):
        return _drawn(spec, settings, seed=seed)
    if spec.startswith("~") and not is_there(spec):  # no shell replaces it in --source=~/clip.mp4
        spec = str(named_path(spec, name="source"))
    spec = spec if is_local(spec) else with_small_scheme(spec)
    scheme = "" if is_local(spec) else spec.partition("://")[0]
    if scheme in LIVE_SCHEMES or (is_description(spec) and is_there(spec)):
        _check_address(spec, scheme)
        stream = kinds.grabber(spec, read_s=patience_s(fps))
        stream.open()
        if not stream.holds_a_clip:
            return kinds.live(stream, settings, clock=clock, failures=failures)
        stream.close()
    elif is_device(spec):
        grabber = CameraGrabber(spec, fps=fps, clock=clock)
        return LiveSource(grabber, settings, clock=clock, failures=failures)
    else:
        _check_there(spec, scheme, growing=growing)
    if not scheme and (Path(spec).is_dir() or (is_tiff(spec) and kinds is _DECODED)):
        return FolderSource(spec, settings)
    return kinds.clip(spec, settings)


def is_demo(spec: str) -> bool:
    """Whether a source's name is the demo's, with or without words after a colon."""
    return spec.partition(":")[0] == "demo"


def _drawn(spec: str, settings: SourceSettings, *, seed: int) -> Source:
    entry = the_one("hvt.scenes", "demo", what="scene", built_in=False)
    if entry is None:
        raise not_installed(f"--source {spec:.200}", "hvt[edge]")
    return cast("Source", loaded(entry, lambda draw: draw(spec, settings, seed=seed), what="scene"))


def _check_address(spec: str, scheme: str) -> None:
    # FFmpeg waits for ever at a port that does not exist, and connects to this machine where there is no host, as
    # from a script with an empty variable. By UDP it also listens on ``?localport=``.
    address = re.split(r"[/?]", spec.partition("://")[2])[0]
    if scheme.startswith(("rtsp", "rtmp", "http")) and address.rpartition("@")[2][:1] in {"", ":"}:
        raise UserError(f"source {shown(spec)!r} names no host: give one, as in {scheme}://camera/stream1")
    port = re.fullmatch(r".*:([0-9]{1,5})", address)
    if scheme == "udp" and port is None:
        port = re.search(r"[?&]localport=([0-9]{1,5})(?:&|$)", spec)
    if scheme in {"udp", "rtp", "tcp"} and not (port and 0 < int(port[1]) < 2**16):
        raise UserError(f"source {shown(spec)!r} names no port: give {scheme}://HOST:PORT, 1 to 65535")


def _check_there(spec: str, scheme: str, *, growing: bool) -> None:
    # A file that another program writes may be yet to come: `NotYetError`.
    if not _is_played(spec) and (is_there(spec) or _PIPE.fullmatch(spec)):
        raise UserError(
            f"source {shown(spec)!r} is neither a file nor a folder; what a program writes into a pipe, or GStreamer "
            "plays, can be sent to udp://127.0.0.1:PORT as MPEG-TS"
        )
    if scheme:
        known = scheme if re.fullmatch(r"[a-z][a-z0-9+.-]{0,15}", scheme) else HIDDEN
        raise UserError(f"source {shown(spec)!r} has the unknown scheme {known!r}; accepted is {_ACCEPTED}")
    if not is_there(spec):
        mistyped = not re.match(r"/[^/]", spec) and shown(spec) != spec
        if not growing and not mistyped and absent(Path(spec)) is NotYetError:
            raise FlightError(
                f"source {shown(spec)!r} is in a folder that does not exist: is its disk mounted?"
            )
        kind = NotYetError if growing and not mistyped else UserError
        hint = ", and an address has a scheme and two slashes" * mistyped
        raise kind(f"source {shown(spec)!r} does not exist{hint}; accepted is {_ACCEPTED}")
    if growing and Path(spec).is_file() and not Path(spec).stat().st_size:
        raise NotYetError(f"source {spec!r} is empty so far")


def shown(spec: str) -> str:
    """``--source`` as it may be printed: a file, a device and the demo as they are."""
    return spec if is_demo(spec) or is_there(spec) else redacted(spec)


def is_device(spec: str) -> bool:
    # An existing file or folder there is no device, as in /dev/shm.
    return spec.startswith("/dev/") and not (_is_played(spec) or _PIPE.fullmatch(spec))


def _is_played(spec: str) -> bool:
    return is_there(spec, Path.is_file) or is_there(spec, Path.is_dir)


def is_there(spec: str, kind: Callable[[Path], bool] = Path.exists) -> bool:
    try:
        return bool(spec) and kind(Path(spec))
    except (OSError, ValueError):  # too long for a name, or with a character that no name has
        return False
