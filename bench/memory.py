"""Memory and threads: an edge at its defaults on the demo with a ground, then a ground of one edge and of eight.

The eight are played from this process: access units of 640x360 at 5 fps, coded once, over eight Zenoh sessions.
"""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import cv2

from bench.bars import measured
from bench.material import frames
from bench.processes import Peaks, free_endpoint, running
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import BaseHeader, ControlAnswer, Flags, Info
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.values import AccessUnit, Frame, View
from hvt_edge.link.publisher import ZenohLink
from hvt_edge.video.encoder_settings import encoder_settings
from hvt_edge.video.x265 import BaseEncoder

_SIZE, _FPS = (640, 360), 5.0
_EDGES = 8
_PLAYED_S = 25.0
# As `pip install hvt[edge]` runs: OpenVINO is an extra.
_PROVIDER = ("--provider", "cpu")


def rows() -> list[dict[str, object]]:
    edge_mb, ground_mb = _demo()
    (one_mb, one_threads), (all_mb, all_threads) = _played(1), _played(_EDGES)
    return [
        measured("edge at its defaults on the 1080p demo, peak MB", edge_mb),
        measured("ground of that edge, peak MB", ground_mb),
        measured("each further edge at the ground, MB", (all_mb - one_mb) / (_EDGES - 1)),
        measured("each further edge at the ground, threads", (all_threads - one_threads) / (_EDGES - 1)),
        measured("ground of one edge of 640x360, peak MB", one_mb),
        measured("ground of one edge of 640x360, threads", one_threads),
    ]


def _demo() -> tuple[float, float]:
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "bench.rrd"
        with (
            running(
                "hvt_ground.cli", *_PROVIDER, "--listen", endpoint, "--once", "--quiet", "--record", record
            ) as ground,
            running("hvt_edge.cli", *_PROVIDER, "--source", "demo", "--connect", endpoint, "--quiet") as edge,
        ):
            peaks = Peaks([edge, ground])
            peaks.until_ended(edge, patience_s=180)
            peaks.until_ended(ground, patience_s=60)
    return peaks.mb[0], peaks.mb[1]


def _played(count: int) -> tuple[float, int]:
    """Peak MB and threads of a ground that so many edges send to."""
    endpoint, clock = free_endpoint(), SteadyClock()
    units = _units()
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        ground = stack.enter_context(
            running("hvt_ground.cli", *_PROVIDER, "--listen", endpoint, "--quiet", "--record", folder)
        )
        peaks = Peaks([ground])
        edges = [_PlayedEdge(stack, f"edge-{number}", number + 1, endpoint, clock) for number in range(count)]
        until_s = time.monotonic() + 60
        while not all(edge.link.has_ground() for edge in edges):
            if time.monotonic() > until_s:
                raise RuntimeError("the ground does not come")
            time.sleep(0.1)
        for index in range(round(_PLAYED_S * _FPS)):
            began_s = time.monotonic()
            for edge in edges:
                edge.send(units[index % len(units)], index)
            peaks.sample()
            time.sleep(max(0.0, 1 / _FPS - (time.monotonic() - began_s)))
    return peaks.mb[0], peaks.threads[0]


class _PlayedEdge:
    def __init__(
        self, stack: ExitStack, edge_id: str, session_id: int, endpoint: str, clock: SteadyClock
    ) -> None:
        self._clock, self._session_id = clock, session_id
        view = View.fitted(_SIZE, _SIZE, fit="letterbox")
        info = Info(
            session_id=session_id, edge=edge_id, software="bench", started_ns=clock(), source_size=_SIZE,
            base_size=_SIZE, view_scale=view.scale, view_offset_px=view.offset_px, fps=_FPS, codec="hevc",
            pace="realtime", method="M0", budget_bps=200_000, base_bps=180_000, window_ns=10**9,
            class_names=("car",), received_ns=clock(), answered_ns=clock(),
        )  # fmt: skip
        settings = LinkSettings(role="edge", connect=(endpoint,))
        self.link = stack.enter_context(
            ZenohLink(settings, edge_id=edge_id, failures=Failures(clock), clock=clock)
        )
        self.link.listen(
            info=lambda _received_ns: info.pack(),
            control=lambda _request: ControlAnswer(
                session_id=session_id,
                accepted=False,
                reason="it is played",
                still_request=-1,
                frame_index=-1,
                tracks=(),
            ),
            on_feedback=lambda _feedback: None,
        )

    def send(self, unit: AccessUnit, index: int) -> None:
        header = BaseHeader(
            session_id=self._session_id,
            sequence=index,
            frame_index=index,
            capture_ns=self._clock(),
            send_delay_ns=0,
            flags=Flags.KEYFRAME if unit.keyframe else Flags(0),
        )
        attachment = header.pack(unit.data)
        self.link.put(Channel.BASE, unit.data, attachment=attachment, encoding="video/h265")


def _units() -> list[AccessUnit]:
    """Two seconds, to be repeated: the first is a keyframe."""
    encoder = BaseEncoder(
        encoder_settings(
            size=_SIZE, fps=_FPS, preset="ultrafast", total_bps=200_000, base_bps=180_000, edge_id="edge-1"
        )
    )
    small = [cv2.resize(one.base_bgr, _SIZE, interpolation=cv2.INTER_AREA) for one in frames(30)[::3]]
    return [
        encoder.encode(Frame(index, index, picture, picture), keyframe=index == 0)
        for index, picture in enumerate(small)
    ]


if __name__ == "__main__":
    for one in rows():
        print(one)
