"""A camera that is GStreamer's RTSP server, a process of its own: it can be killed, hang, and be started again.

Debian's packages have it: python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-ugly.
"""

import signal
import subprocess
from types import TracebackType
from typing import Self

SIZE, FPS = (320, 240), 25
_PYTHON = "/usr/bin/python3"
"""The system's, which has the bindings; a virtual environment does not."""
_IMPORTS = """
import sys
import gi
gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtsp, GstRtspServer
Gst.init(None)
"""
_CHECK = _IMPORTS + 'sys.exit(not all(map(Gst.ElementFactory.find, ("x264enc", "x265enc", "rtph265pay"))))'
_SERVE = (
    _IMPORTS
    + """
factory = GstRtspServer.RTSPMediaFactory(shared=True)
factory.set_launch(sys.argv[2])
if sys.argv[3] == "udp":
    factory.set_protocols(GstRtsp.RTSPLowerTrans.UDP)
server = GstRtspServer.RTSPServer(address="127.0.0.1", service=sys.argv[1])
server.get_mount_points().add_factory("/camera", factory)
if not server.attach(None):
    sys.exit("the port is taken")
print("serves", flush=True)
GLib.MainLoop().run()
"""
)
_CODERS = {
    "h264": f"x264enc tune=zerolatency speed-preset=ultrafast key-int-max={FPS} bitrate=300 ! rtph264pay",
    "hevc": f"x265enc tune=zerolatency speed-preset=ultrafast key-int-max={FPS} bitrate=300 ! rtph265pay",
}


def lacking() -> str:
    """Why there is no such camera on this machine; empty where there is."""
    try:
        found = subprocess.run([_PYTHON, "-c", _CHECK], capture_output=True, check=False)
    except OSError:
        return f"there is no {_PYTHON}"
    packages = "python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-ugly"
    return f"GStreamer's RTSP server is not installed (Debian: {packages})" if found.returncode else ""


class GStreamerCamera:
    """A moving ball in ``h264`` or ``hevc``, a keyframe each second; ``by`` UDP alone, or as the viewer asks."""

    def __init__(self, port: int, *, codec: str = "h264", by: str = "") -> None:
        self.url = f"rtsp://127.0.0.1:{port}/camera"
        picture = f"video/x-raw,format=I420,width={SIZE[0]},height={SIZE[1]},framerate={FPS}/1"
        launch = f"( videotestsrc is-live=true pattern=ball ! {picture} ! {_CODERS[codec]} name=pay0 pt=96 )"
        self._process = subprocess.Popen(
            [_PYTHON, "-c", _SERVE, str(port), launch, by],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self._process.stdout is not None, "it was opened with a pipe"
        assert self._process.stdout.readline() == "serves\n", f"no camera at {self.url}"

    def kill(self) -> None:
        """The power fails; calling it twice does no harm."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None, "it was opened with a pipe"
        self._process.stdout.close()

    def hang(self) -> None:
        """It sends nothing any more, and leaves the connection open."""
        self._process.send_signal(signal.SIGSTOP)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()
