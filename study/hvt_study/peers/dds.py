"""A server-driven two-pass peer in the manner of DDS, on our codec, our link and our accounting.

Du et al., "Server-Driven Video Streaming for Deep Learning Inference", SIGCOMM 2020. The edge sends every frame at a
low quality; the ground looks at a segment of them, keeps what it is sure of and asks for the regions that it is not
sure of; the edge codes the same frames again with these regions alone, the rest black; the ground pastes them into
the first pass, looks again, and merges both into the final results, over which a tracker runs. What is as in
DDS and what differs: docs/design-notes/dds.md.

Every byte counts, once: the first pass as ``base``, the second as ``roi``, what the ground asks as ``control``. All
of it stays within the budget in every rolling window, and over the clip: the last second pass, which comes after the
clip's end, is cut short where it would go beyond.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from itertools import groupby

from hvt_common.inference.detect import Detector
from hvt_common.values import Frame
from hvt_edge.link.budget import RollingBudget
from hvt_edge.source.resample import Resizer
from hvt_study.datasets.sequence import NOMINAL_FPS, Clip, FrameSource
from hvt_study.flights.flight import FlightReport, coded_frames, picture_age_p95_ms
from hvt_study.flights.flight_link import START_NS, frame_ns
from hvt_study.peers.dds_edge import DdsEdge, pass_rates
from hvt_study.peers.dds_ground import DdsGround
from hvt_study.peers.dds_line import Line
from hvt_study.peers.dds_regions import DdsSettings
from hvt_study.serial_link import LinkReport

_LONGEST_TAIL_S = 30
"""How long after the clip the last second pass may take."""


def fly_dds(
    clip: Clip,
    *,
    budget_bps: int,
    link_bps: int,
    size: tuple[int, int],
    detector: Detector,
    edge_id: str = "edge-1",
    settings: DdsSettings = DdsSettings(),  # noqa: B008 - frozen
) -> FlightReport:
    """Fly the peer once; ``detector`` is the ground's, ``size`` (width, height) that of the base frames.

    The list of a frame is the final one of that very frame, as an operator sees it when it is known, which is later
    than with a stream that is shown as it comes: the delays of ``FlightReport.link`` are, for each coded frame, from
    capture to the arrival of the pass that completes it (segment, question, second pass, and the frames before it).
    ``picture_age_p95_ms`` is of the newest picture at the ground, that of a first pass, as in
    `hvt_study.flights.flight.fly`. Raises `UserError` where the budget is too small for two passes of this size and
    frame rate.
    """
    settings = settings.resolved(budget_bps, size=size)
    rates = pass_rates(budget_bps, size=size, settings=settings, edge_id=edge_id)
    line = Line(
        link_bps=link_bps, budget=RollingBudget(rates.budget), window_ns=settings.window_ns, edge_id=edge_id
    )
    coded = coded_frames(clip.frame_count, settings.rate)
    segments = _segments(coded, settings.segment_frames)
    most_bytes = int(budget_bps * clip.frame_count / NOMINAL_FPS / 8)
    resizer = Resizer(clip.source_size, size, fit="letterbox")
    edge = DdsEdge(rates, size=size, settings=settings, segments=segments, line=line, most_bytes=most_bytes)
    ground = DdsGround(detector, settings, resizer.view, segments, line, started_ns=frame_ns(0))
    with closing(_by_frame(FrameSource(clip, resizer, frames=coded), clip.frame_count)) as frames:
        for now_ns, frame in frames:
            ground.advance(now_ns)
            while ground.requests and ground.requests[0][0] <= now_ns:
                edge.on_request(ground.requests.popleft()[1])
            if frame is not None:
                edge.first_pass(frame)
            edge.second_pass(now_ns)
            if now_ns > frame_ns(clip.frame_count) and edge.idle and line.empty and not ground.requests:
                break
    ground.close(frames=clip.frame_count)
    return _report(clip.frame_count, edge=edge, ground=ground, line=line)


def _segments(coded: frozenset[int], segment_frames: int) -> tuple[tuple[int, ...], ...]:
    """The coded frames of each segment that has any."""
    return tuple(
        tuple(frames)
        for _, frames in groupby(sorted(coded), key=lambda frame_index: frame_index // segment_frames)
    )


def _by_frame(source: FrameSource, frames: int) -> Generator[tuple[int, Frame | None], None, None]:
    """(time, frame to code) of every frame, and empty ones after the clip for what is still to come."""
    frame_index = 0
    for frame in source.frames(start_ns=START_NS):
        for between in range(frame_index, frame.index):
            yield frame_ns(between), None
        yield frame.capture_ns, frame
        frame_index = frame.index + 1
    for after in range(frame_index, frames + round(_LONGEST_TAIL_S * NOMINAL_FPS)):
        yield frame_ns(after), None


def _report(frames: int, *, edge: DdsEdge, ground: DdsGround, line: Line) -> FlightReport:
    return FlightReport(
        lists=tuple(ground.lists[frame_index] for frame_index in range(frames)),
        account=line.ledger.summary(frames / NOMINAL_FPS),
        line_bytes=dict(line.line_bytes),
        messages=dict(line.messages),
        max_frame_bytes=line.max_frame_bytes,
        link=LinkReport.of(ground.delays_ns, line.arrivals),
        picture_age_p95_ms=picture_age_p95_ms(ground.shown_ns, frames),
        edge_cpu_ms=1e3 * edge.cpu_s / frames,
        digest=line.digest,
    )
