"""An RTSP camera of another make, GStreamer's server, that dies or hangs in flight and is started again."""

import time
from contextlib import ExitStack
from itertools import pairwise

import pytest

from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_edge.source.opening import open_source
from programs.gstreamer_camera import SIZE, GStreamerCamera, lacking

pytestmark = [pytest.mark.nightly, pytest.mark.integration]


@pytest.fixture(scope="module", autouse=True)
def _installed() -> None:
    if reason := lacking():
        pytest.skip(reason)


def test_a_camera_that_sends_by_udp_alone_is_shown(free_port):
    """It was asked for TCP alone, and waited for till the flight was over."""
    with ExitStack() as held:
        camera = held.enter_context(GStreamerCamera(free_port, by="udp"))
        source = held.enter_context(open_source(camera.url, size=SIZE, fps=25, max_frames=1))
        (frame,) = source.frames(start_ns=0)
    assert frame.base_bgr.max() > 200, "the ball, and no grey"


@pytest.mark.parametrize(("codec", "end"), [("h264", "kill"), ("hevc", "kill"), ("h264", "hang")])
def test_the_picture_is_back_when_the_camera_is(free_port, codec, end):
    """A camera that reboots in the air would end the video, or be called so often that it cannot start."""
    failures = Failures(time.time_ns)
    tries: list[int] = []
    frames = []
    camera = GStreamerCamera(free_port, codec=codec)
    try:
        with open_source(camera.url, size=SIZE, fps=25, failures=failures) as source:
            before = 0
            for frame in source.steps(start_ns=0):
                if frame is not None:
                    frames.append(frame)
                    if len(frames) == 20:
                        getattr(camera, end)()
                        before = len(frames)
                    if source.restarts and len(frames) >= before + 40:
                        break
                    continue
                (failed,) = failures.parts or (None,)
                if failed is None or tries[-1:] == [failed.failed_ns]:
                    continue
                tries.append(failed.failed_ns)
                if len(tries) == 4:
                    camera.kill()
                    camera = GStreamerCamera(free_port, codec=codec)
            assert source.restarts == 1
    finally:
        camera.kill()
    (failed,) = failures.parts
    assert (failed.part, failed.working) == ("source", True)
    assert camera.url in failed.reason
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert all(later.capture_ns > earlier.capture_ns for earlier, later in pairwise(frames))
    assert frames[-1].base_bgr.max() > 200, "the ball, and no grey"
    pauses = [later - earlier for earlier, later in pairwise(tries)]
    assert pauses[-1] > pauses[0], "it is called less and less often"
    assert pauses[-1] > SECOND_NS
