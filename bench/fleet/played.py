"""Edges without a camera, for benchmarks of the ground: the stream of one encoder is sent over many Zenoh sessions.

So the edges take next to nothing of the machine that the ground is measured on.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace

import numpy as np

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import BaseHeader, ControlAnswer, Flags, Info
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.values import AccessUnit, Frame, View
from hvt_edge.link.publisher import Answers, ZenohLink
from hvt_edge.video.encoder import encoder_settings
from hvt_edge.video.x265 import BaseEncoder

SIZE = (640, 360)


class PlayedEdge:
    def __init__(
        self, stack: ExitStack, edge_id: str, session_id: int, endpoint: str, clock: SteadyClock, fps: float
    ) -> None:
        self._clock, self._session_id = clock, session_id
        view = View.fitted(SIZE, SIZE, fit="letterbox")
        info = Info(
            session_id=session_id, edge=edge_id, software="bench", started_ns=clock(), source_size=SIZE,
            base_size=SIZE, view_scale=view.scale, view_offset_px=view.offset_px, fps=fps, codec="hevc",
            pace="realtime", method="M0", budget_bps=200_000, base_bps=180_000, window_ns=10**9,
            class_names=("car",), received_ns=clock(), answered_ns=clock(),
        )  # fmt: skip
        settings = LinkSettings(role="edge", connect=(endpoint,))
        self.link = stack.enter_context(
            ZenohLink(settings, edge_id=edge_id, failures=Failures(clock), clock=clock)
        )
        self.link.listen(
            Answers(
                info=lambda at_ns: replace(info, received_ns=at_ns, answered_ns=clock()).pack(),
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


def played(
    stack: ExitStack,
    count: int,
    endpoint: str,
    units: Sequence[AccessUnit],
    *,
    fps: float,
    lasts_s: float,
    on_round: Callable[[], None],
) -> None:
    """Send ``units`` again and again as so many edges, until ``lasts_s`` after the last ground has come."""
    clock = SteadyClock()
    edges = [PlayedEdge(stack, f"edge-{number}", number + 1, endpoint, clock, fps) for number in range(count)]
    until_s = time.monotonic() + 60
    while not all(edge.link.has_ground() for edge in edges):
        if time.monotonic() > until_s:
            raise RuntimeError("the ground does not come")
        time.sleep(0.1)
    began_s = time.monotonic()
    for index in range(round(lasts_s * fps)):
        for edge in edges:
            edge.send(units[index % len(units)], index)
        on_round()
        time.sleep(max(0.0, began_s + (index + 1) / fps - time.monotonic()))


def coded(pictures: Iterable[np.ndarray], *, fps: float) -> list[AccessUnit]:
    """Access units of pictures of `SIZE`, to be repeated: the first is a keyframe."""
    encoder = BaseEncoder(
        encoder_settings(
            size=SIZE, fps=fps, preset="ultrafast", total_bps=200_000, base_bps=180_000, edge_id="edge-1"
        )
    )
    return [
        encoder.encode(Frame(index, index, picture, picture), keyframe=index == 0)
        for index, picture in enumerate(pictures)
    ]
