"""A whole edge in media time, of which stills are requested at chosen frames; its link keeps all that is sent."""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import BaseHeader, ControlAnswer, ControlRequest, Info, RoiHeader
from hvt_common.runtime.clock import SteadyClock
from hvt_common.values import Frame, Image, View
from hvt_common.video.base_crop import base_crop
from hvt_common.video.hevc import BaseDecoder
from hvt_common.video.still_codecs import psnr_y_db, still_codec
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_edge.link.publisher import Answers
from hvt_edge.source.contract import Source
from hvt_edge.world import World
from media.clips import START_NS
from rigs.world import PassedOn


class _StandingClock(SteadyClock):
    """In lockstep the source alone says what time it is."""

    def __call__(self) -> int:
        return START_NS


@dataclass(eq=False)
class RequestedLook:
    """One request, and what became of it."""

    index: int
    """Of the frame before which it was made."""
    arguments: Mapping[str, int]
    answer: ControlAnswer | None = None
    asked_ns: int = 0
    refusal: str = ""
    note: str = ""
    header: RoiHeader | None = None
    size_bytes: int = 0
    image: Image | None = None
    source: Image | None = None
    """The source's pixels of the same crop, at the size of the still."""
    base: Image | None = None
    """What the base shows of it in that very frame."""

    @property
    def delay_s(self) -> float:
        assert self.header is not None, self.refusal
        return (self.header.send_ns - self.asked_ns) / 1e9

    @property
    def psnr_db(self) -> tuple[float, float]:
        assert self.image is not None
        assert self.source is not None
        assert self.base is not None
        return psnr_y_db(self.image, self.source), psnr_y_db(self.base, self.source)


@dataclass(eq=False)
class LookFlight(World):
    """One flight; build it, then `run`."""

    settings: Mapping[str, Any]
    looks: Sequence[RequestedLook]
    open: Callable[[EdgeConfig], Source] | None = None
    """Another source than that of the settings."""
    sources: dict[int, Image] = field(default_factory=dict)
    """Of the frames for which there is still a use."""

    def __post_init__(self) -> None:
        super().__init__()
        self.clock = _StandingClock()
        self.view: View | None = None
        self._decoder = BaseDecoder()
        self._bases: dict[int, Image] = {}
        self._control: Callable[[ControlRequest], ControlAnswer] | None = None
        self.base_times_ns: list[int] = []
        """When access units went out."""

    # The world

    def open_source(self, config: EdgeConfig) -> Source:
        inner = super().open_source(config) if self.open is None else self.open(config)
        self.view = inner.view
        return PassedOn(inner, before=self.before)

    def open_link(self, stack: Any, config: EdgeConfig) -> Any:
        return self

    # The link

    unusable, trouble = 0, ""

    def has_ground(self) -> bool:
        return False

    def has_subscriber(self, channel: Channel) -> bool:
        return True

    def mend(self) -> None:
        """It loses nothing."""

    def listen(self, answers: Answers) -> None:
        self._control = answers.control
        self.info = Info.parse(answers.info(START_NS))

    def put(
        self, channel: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        if channel is Channel.BASE:
            header = BaseHeader.parse(attachment, payload)
            self.base_times_ns.append(header.capture_ns + header.send_delay_ns)
            picture = self._decoder.decode_yuv(payload)
            assert picture is not None
            self._bases[header.frame_index] = picture  # type: ignore[assignment]
            self._bases.pop(header.frame_index - 120, None)
        elif channel is Channel.ROI:
            self._take(RoiHeader.parse(attachment, payload), payload)

    # Requests

    def command(self, command: str, **arguments: Any) -> ControlAnswer:
        assert self._control is not None
        return self._control(ControlRequest(session_id=0, command=command, arguments=arguments))

    def before(self, frame: Frame) -> None:
        """Request what is due before this frame, and ask what became of what was requested before."""
        self.sources[frame.index] = frame.source_bgr
        self.sources.pop(frame.index - 120, None)
        for look in self.looks:
            if look.index == frame.index and self._control is not None:
                look.asked_ns = frame.capture_ns
                look.answer = self.command("still", **look.arguments)
                look.refusal = look.answer.reason
            elif (
                look.answer is not None and look.answer.accepted and look.header is None and not look.refusal
            ):
                outcome = self.command("still-outcome", ask=look.answer.still_request)
                look.refusal, look.note = outcome.reason, outcome.note or look.note

    def _take(self, header: RoiHeader, data: bytes) -> None:
        for look in self.looks:
            if look.answer is None or header.parameters.get("ask") != look.answer.still_request:
                continue
            x1, y1, x2, y2 = header.crop_source_px
            size: Any = header.parameters.get("w", x2 - x1), header.parameters.get("h", y2 - y1)
            look.header, look.size_bytes = header, len(data)
            look.image = still_codec(header.codec).decode(data, size=size, parameters=header.parameters)
            look.source = np.ascontiguousarray(self.sources[header.frame_index][y1:y2, x1:x2])
            picture, view = self._bases.get(header.frame_index), self.view
            assert view is not None
            if picture is not None:
                look.base = base_crop(
                    picture, view=view, crop_source_px=header.crop_source_px, size=(x2 - x1, y2 - y1)
                )

    def run(self) -> dict[str, Any]:
        config = EdgeConfig(pace="lockstep", edge_id="uav-1", quiet=True, wait=0.0, **self.settings)
        config = check(with_profile(config, given=set(self.settings)))
        return Edge(config, stop=threading.Event(), world=self).run()
