"""Writes a session as MPEG-TS: the base stream as it came, and KLV beside it with the place of the camera and tracks.

MISB ST 1402, asynchronous carriage: a KLV packet has the time of its frame, and may come after it.
"""

from __future__ import annotations

import heapq
import io
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import av
import av.error
from av.container import OutputContainer
from av.stream import Stream

from hvt_common.errors import UserError
from hvt_common.values import View
from hvt_gateways.decodable import DecodableRun
from hvt_gateways.transport_stream.destination import (
    Address,
    Addresses,
    AsynchronousKlv,
    Datagrams,
    Output,
    StreamFile,
)
from hvt_gateways.transport_stream.moments import TIME_BASE, Moment, Moments, Timeline
from hvt_gateways.transport_stream.uas import Platform, uas_local_set
from hvt_ground.events import Event, Overlay, PoseUpdate, VideoSample
from hvt_ground.poses import PoseTrail
from hvt_ground.sinks import SinkWriter

if TYPE_CHECKING:
    from hvt_ground.recordings.row import Recorded

_BUFFER_BYTES: Final = 24 * 7 * 188
"""A buffer of whole datagrams of whole packets."""
_DELAY_US: Final = "200000"
"""Delay of a receiver's clock behind the times in the stream: metadata may come later than its picture by this."""
_USUAL_FPS: Final = 15.0
"""A recording does not say it; it counts where a clock was set."""


class TransportStream(SinkWriter[Event]):
    """Writes into ``output``, or to an SRT URL; ``trail`` has the poses where all are known before.

    ``ended`` is called once after the end. Events stored at the edge during an outage are left out: a stream does
    not go back.
    """

    def __init__(
        self,
        output: Output | str,
        *,
        platform: Platform,
        fps: float,
        trail: PoseTrail | None = None,
        ended: Callable[[], None] | None = None,
    ) -> None:
        self._platform = platform
        self._output = None
        if not isinstance(output, str):
            self._output = output = AsynchronousKlv(output)
        self._ended = ended
        self._trail = trail or PoseTrail()
        self._timeline = Timeline(fps=fps)
        self._moments = Moments()
        self._run = DecodableRun()
        # Without the first two a picture would wait for metadata of its time, up to ten seconds.
        options = {"max_interleave_delta": "1", "flush_packets": "1", "max_delay": _DELAY_US}
        self._container: OutputContainer | None = None
        try:
            container = av.open(output, "w", format="mpegts", options=options, buffer_size=_BUFFER_BYTES)
            self._video, self._klv = _streams(container, platform)
            self._container = container
        except av.error.FFmpegError as error:
            raise UserError(f"--ts cannot be opened: {error.strerror}") from error
        finally:
            if self._container is None and self._output is not None:
                self._output.close()

    def log(self, item: Event) -> None:
        """Write a picture or the facts of a frame; other events pass by."""
        match item:
            case VideoSample(stored=False):
                self._picture(item)
            case Overlay(stored=False) if self._timeline.begun:
                self._say(self._moments.tracks(item, at=self._timeline.of(item.capture_ns)))
            case PoseUpdate():
                self._trail.add(item.pose)

    def skipped(self, count: int) -> None:
        """Count missing events: it goes on at the next keyframe."""
        del count
        self._run.interrupt()
        self._moments.forget()

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        """Write waiting facts, and end."""
        container = self._container
        if container is None:
            return
        try:
            self._say(self._moments.rest())
            self._container = None
            container.close()
        except av.error.FFmpegError as error:
            raise UserError(f"--ts cannot be finished: {error.strerror}") from error
        finally:
            self._container = None
            if self._output is not None:
                self._output.close()
            if self._ended is not None:
                self._ended()

    def _picture(self, sample: VideoSample) -> None:
        data = self._run.decodable(sample)
        if not data:
            return
        at = self._timeline.picture(sample.capture_ns)
        self._mux(self._video, data, at, keyframe=sample.keyframe)
        self._say(self._moments.picture(sample.frame_index, sample.capture_ns, at=at))

    def _say(self, moments: Iterable[Moment]) -> None:
        for moment in moments:
            if self._timeline.metadata(moment.at):
                data = uas_local_set(
                    self._platform,
                    capture_ns=moment.capture_ns,
                    pose=self._trail.at(moment.capture_ns),
                    overlay=moment.overlay,
                )
                self._mux(self._klv, data, moment.at, keyframe=True)

    def _mux(self, stream: Stream, data: bytes, at: int, *, keyframe: bool) -> None:
        if self._container is None:
            return
        packet = av.Packet(data)
        packet.stream, packet.time_base = stream, TIME_BASE
        packet.pts = packet.dts = at
        packet.is_keyframe = keyframe
        try:
            self._container.mux(packet)
        except av.error.FFmpegError as error:
            raise UserError(f"--ts cannot be written any further: {error.strerror}") from error


def stream_file(
    path: Path, *, platform: Platform, fps: float, trail: PoseTrail | None = None
) -> TransportStream:
    """A stream into a file; takes the place of one of that name. `UserError` where it cannot be written."""
    stream = TransportStream(StreamFile(path), platform=platform, fps=fps, trail=trail)
    stream.path = path
    return stream


def live_stream(address: Address, *, platform: Platform, fps: float, addresses: Addresses) -> TransportStream:
    """A stream to a receiver. `UserError` where another goes there, or it cannot be reached."""
    with addresses.taken(address, edge=platform.edge):
        return TransportStream(
            address.srt_url if address.scheme == "srt" else Datagrams(address),
            platform=platform,
            fps=fps,
            ended=lambda: addresses.free(address),
        )


def write_recorded(recorded: Recorded, path: Path) -> None:
    """Write a recording as ``--ts`` would have; `UserError` where it has no video."""
    if recorded.info is not None:
        view = recorded.info.view
    elif recorded.poses:
        view = recorded.poses[0].view
    else:
        with av.open(io.BytesIO(recorded.decodable_video()[0].data), format="hevc") as probe:
            size = probe.streams.video[0].width, probe.streams.video[0].height
        view = View.fitted(size, size, fit="letterbox")
    platform = Platform(recorded.edge, recorded.session, view, recorded.locator)
    stream = stream_file(path, platform=platform, fps=_USUAL_FPS, trail=recorded.trail)
    items: Iterator[VideoSample | Overlay] = heapq.merge(
        recorded.video, recorded.overlays(), key=lambda one: one.frame_index
    )
    try:
        for item in items:
            stream.log(item)
    except BaseException:
        with suppress(UserError):  # the first failure is the reason
            stream.close()
        raise
    stream.close()


def _streams(container: OutputContainer, platform: Platform) -> tuple[Stream, Stream]:
    """Video and KLV of a stream whose head is written."""
    container.metadata["service_name"] = platform.edge
    container.metadata["service_provider"] = "HVT"
    width, height = platform.view.base_size
    video: Stream = container.add_mux_stream("hevc", width=width, height=height)
    klv: Stream = container.add_data_stream("klv")
    video.time_base = klv.time_base = TIME_BASE
    container.start_encoding()
    return video, klv
