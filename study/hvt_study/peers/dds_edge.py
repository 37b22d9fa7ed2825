"""The camera's end of the two-pass peer, and the line to its server.

It codes every frame once, and requested regions a second time. Every message is weighed, counted once and sent over a
serial link.
"""

import hashlib
import struct
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from hvt_common.errors import UserError
from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import Account, Ledger, overhead_bytes
from hvt_common.protocol.messages import BaseHeader, Flags
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit, Frame, Image
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.video.encoder import EncoderSettings, keyframe_floor_bytes, minimum_bps, vbv_s
from hvt_edge.video.x265 import BaseEncoder
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.flights.flight_link import Arrival, SerialLink
from hvt_study.peers.dds_regions import Blocks, DdsSettings, RegionRequest, block_grid, pasted

HEADER_BYTES = 44
"""The largest `BaseHeader`."""
_SESSION = 1 << 31  # as many bytes on the wire as a random one
_CHANNELS = {Channel.BASE: Account.BASE, Channel.ROI: Account.ROI, Channel.CONTROL: Account.META}
_KEYS = EdgeKeys("edge-1")
_VIDEO = DELIVERIES[Channel.BASE].encoding
_FURTHER = struct.Struct(">II")
"""Before each access unit but the first: its frame and its length."""


@dataclass(frozen=True, slots=True)
class UnitMessage:
    """Access units of one of the passes, as the ground gets them: one of the first, or some of the second."""

    row: Channel
    units: tuple[AccessUnit, ...]


def header_bps(line_bps: float, *, units_per_s: float, messages_per_s: float, row: Channel) -> float:
    """The part of headers and transport in ``line_bps``."""
    payload = round(line_bps / 8 / messages_per_s)
    around = HEADER_BYTES + overhead_bytes(payload, HEADER_BYTES, key=_KEYS[row], encoding=_VIDEO)
    return 8 * (messages_per_s * around + (units_per_s - messages_per_s) * _FURTHER.size)


class Line:
    """Both directions. Edge to ground goes over a simulated link; requests of the ground take their own time back."""

    def __init__(self, *, link_bps: int, budget: RollingBudget, window_ns: int) -> None:
        self.budget = budget
        self.ledger = Ledger(window_ns=window_ns, slack_ns=4 * window_ns)
        self.line_bytes: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.max_frame_bytes = 0
        self.arrivals: list[Arrival[None]] = []
        """All messages that crossed, without their content."""
        self._link: SerialLink[UnitMessage] = SerialLink(rate_bps=link_bps)
        self._link_bps = link_bps
        self._digest = hashlib.sha256()
        self._under_way = 0

    @property
    def digest(self) -> str:
        return self._digest.hexdigest()

    @property
    def total_bytes(self) -> int:
        """Line bytes of everything that was sent."""
        return self.line_bytes.total()

    @property
    def empty(self) -> bool:
        """Whether everything that was sent to the ground has been taken out."""
        return not self._under_way

    def message_bytes(self, row: Channel, units: Sequence[AccessUnit], *, at_ns: int) -> int:
        """Line bytes of a message with these access units, were it sent then."""
        payload = _payload(units)
        attachment = self._header(row, units[0], at_ns=at_ns).pack(payload)
        return self._weight(row, payload, attachment, encoding=_VIDEO)

    def send(self, row: Channel, units: Sequence[AccessUnit], *, at_ns: int) -> int:
        """Edge to ground; return the line bytes. The budget is the caller's to tell."""
        payload = _payload(units)
        attachment = self._header(row, units[0], at_ns=at_ns).pack(payload)
        size_bytes = self._count(row, payload, attachment, encoding=_VIDEO, at_ns=at_ns)
        self.max_frame_bytes = max(self.max_frame_bytes, *(len(unit.data) for unit in units))
        self._link.put(
            UnitMessage(row, tuple(units)),
            size_bytes=size_bytes,
            enter_ns=at_ns,
            urgent=row is Channel.BASE,
        )
        self._under_way += 1
        return size_bytes

    def send_request(self, payload: bytes, *, now_ns: int) -> int:
        """Ground to edge as soon as the budget's window has room; return when it is there."""
        size_bytes = self._weight(
            Channel.CONTROL, payload, b"", encoding=DELIVERIES[Channel.CONTROL].encoding
        )
        at_ns = self.budget.earliest_ns(size_bytes, now_ns=now_ns)
        self._count(Channel.CONTROL, payload, b"", encoding=DELIVERIES[Channel.CONTROL].encoding, at_ns=at_ns)
        self.budget.record_metadata(size_bytes, now_ns=at_ns)
        return at_ns + round(size_bytes * 8 * SECOND_NS / self._link_bps)

    def arrived(self, now_ns: int) -> list[Arrival[UnitMessage]]:
        """Messages that have reached the ground by now."""
        there = self._link.arrived(now_ns)
        self._under_way -= len(there)
        self.arrivals += [
            Arrival(None, one.size_bytes, one.urgent, one.enter_ns, one.arrival_ns) for one in there
        ]
        return there

    def _header(self, row: Channel, unit: AccessUnit, *, at_ns: int) -> BaseHeader:
        return BaseHeader(
            session_id=_SESSION,
            sequence=self.messages[row],
            frame_index=unit.frame_index,
            capture_ns=unit.capture_ns,
            send_delay_ns=at_ns - unit.capture_ns,
            flags=int(Flags.LOCKSTEP | ((Flags.KEYFRAME | Flags.PARAMETER_SETS) if unit.keyframe else 0)),
        )

    def _weight(self, row: Channel, payload: bytes, attachment: bytes, *, encoding: str) -> int:
        key = _KEYS[row]
        around = overhead_bytes(len(payload), len(attachment), key=key, encoding=encoding)
        return len(payload) + len(attachment) + around

    def _count(self, row: Channel, payload: bytes, attachment: bytes, *, encoding: str, at_ns: int) -> int:
        size_bytes = self._weight(row, payload, attachment, encoding=encoding)
        self.ledger.count(
            _CHANNELS[row],
            payload_bytes=len(payload),
            attachment_bytes=len(attachment),
            overhead_bytes=size_bytes - len(payload) - len(attachment),
            at_ns=at_ns,
        )
        self.line_bytes[row] += size_bytes
        self.messages[row] += 1
        self._digest.update(payload)
        return size_bytes


def _payload(units: Sequence[AccessUnit]) -> bytes:
    """The first is the header's; the others carry their own kind."""
    first, *others = units
    return first.data + b"".join(_FURTHER.pack(one.frame_index, len(one.data)) + one.data for one in others)


_KEYFRAME_DEBT_S = 10
"""x265 never takes back the bits of the first keyframe beyond a frame's share: so much media time pays for them."""
_BLACK_FRAME_BYTES = 100
"""The size of a frame with very little in it, by x265."""
_STORED_SEGMENTS = 4
_STORED_LEAST = 8


@dataclass(frozen=True, slots=True)
class PassRates:
    """Each pass's part of the budget: the payload rate of its encoder."""

    first_bps: int
    second_bps: int
    budget: BudgetSettings


def pass_rates(budget_bps: int, *, size: tuple[int, int], settings: DdsSettings) -> PassRates:
    """Share out a budget of line bits a second; `UserError` where x265 cannot follow the rate left for a pass."""
    request_bps = settings.request_bps
    first_line = settings.share * (budget_bps - request_bps)
    second_line = budget_bps - request_bps - first_line
    fps = settings.fps
    questions = NOMINAL_FPS / settings.segment_frames
    bundles = min(fps, max(questions, second_line / 8 / settings.bundle_bytes))
    small = settings.first_size(size)
    first = first_line - _beside_bps(first_line, Channel.BASE, small, fps=fps, messages_per_s=fps)
    second = second_line - _beside_bps(second_line, Channel.ROI, size, fps=fps, messages_per_s=bundles)
    # Of the second pass most is black.
    for payload, least in ((first, minimum_bps(small, fps)), (second, 8 * _BLACK_FRAME_BYTES * fps)):
        if payload < least:
            raise UserError(
                f"DDS with {budget_bps} bps at {size[0]}x{size[1]} and {fps:g} fps leaves {payload:.0f} bps for a "
                f"pass that needs {least:.0f}: use a larger budget, fewer frames a second, or another share or scale"
            )
    shared = BudgetSettings(
        total_bps=budget_bps,
        base_bps=round(first_line),
        fps=fps,
        window_ns=settings.window_ns,
        metadata_bps=round(request_bps),
        borrow_unused=True,
    )
    return PassRates(round(first), round(second), shared)


def _beside_bps(
    line_bps: float, row: Channel, size: tuple[int, int], *, fps: float, messages_per_s: float
) -> float:
    """The part of a pass's rate that x265 may not spend."""
    headers = header_bps(line_bps, units_per_s=fps, messages_per_s=messages_per_s, row=row)
    return headers + 8 * keyframe_floor_bytes(size) / _KEYFRAME_DEBT_S


def most_stored(settings: DdsSettings) -> int:
    """How many frames either end keeps at most while it waits for the other."""
    return max(
        _STORED_LEAST, round(_STORED_SEGMENTS * settings.segment_frames * settings.fps / NOMINAL_FPS) + 1
    )


class DdsEdge:
    """Two encoders over one budget, opened with `pass_rates` as ``line.budget`` was.

    A frame stays in memory until the ground's answer about it has come and gone. A second pass that would take the
    flight beyond ``most_bytes`` on the line is not sent.
    """

    def __init__(
        self,
        rates: PassRates,
        *,
        size: tuple[int, int],
        settings: DdsSettings,
        segments: Sequence[tuple[int, ...]],
        line: Line,
        most_bytes: int,
    ) -> None:
        self._settings, self._size, self._line = settings, size, line
        self._most_bytes = most_bytes
        self._budget: RollingBudget = line.budget
        self._segments = {frames[0]: frames for frames in segments}
        self._first_size = settings.first_size(size)
        fps, preset, depth_s = settings.fps, settings.preset, vbv_s(settings.fps)
        self._first, self._second = (
            BaseEncoder(EncoderSettings(coded, fps=fps, bitrate_bps=rate_bps, preset=preset, vbv_s=depth_s))
            for coded, rate_bps in ((self._first_size, rates.first_bps), (size, rates.second_bps))
        )
        self._most = most_stored(settings)
        self._stored: dict[int, Frame] = {}
        self._requested: deque[tuple[int, Blocks]] = deque()
        self._ready: list[AccessUnit] = []
        self._first_done = self._second_done = False
        self.cpu_s = 0.0

    @property
    def idle(self) -> bool:
        """Nothing that was asked for waits."""
        return not self._requested and not self._ready

    def first_pass(self, frame: Frame) -> None:
        began_s = time.process_time()
        self._store(frame)
        small = replace(frame, base_bgr=self._shrunk(frame))
        unit = self._first.encode(small, keyframe=not self._first_done)
        self._first_done = True
        size_bytes = self._line.message_bytes(Channel.BASE, (unit,), at_ns=frame.capture_ns)
        at_ns = self._budget.earliest_ns(size_bytes, now_ns=frame.capture_ns, base=True)
        sent = self._line.send(Channel.BASE, (unit,), at_ns=at_ns)
        self._budget.record_base(sent, now_ns=at_ns, keyframe=unit.keyframe)
        self.cpu_s += time.process_time() - began_s

    def on_request(self, payload: bytes) -> None:
        grid = block_grid(self._size, align_px=self._settings.align_px)
        request = RegionRequest.parse(payload, grid=grid)
        frames = self._segments[request.first_frame]
        for frame_index in [
            stored
            for stored in self._stored
            if stored < request.first_frame and not self._is_requested(stored)
        ]:
            del self._stored[frame_index]  # about these the ground had no question
        for frame_index, blocks in zip(frames, request.frames, strict=True):
            if not blocks.any():
                self._stored.pop(frame_index, None)
            elif frame_index in self._stored:
                self._requested.append((frame_index, blocks))

    def second_pass(self, now_ns: int) -> None:
        """Code and send requested regions, as far as the budget has room now."""
        began_s = time.process_time()
        while not self.idle:
            self._fill()
            size_bytes = self._line.message_bytes(Channel.ROI, self._ready, at_ns=now_ns)
            if self._line.total_bytes + size_bytes > self._most_bytes:
                self._ready.clear()
                self._requested.clear()
                self._most_bytes = 0  # later ones would build on those left out
                break
            if size_bytes > self._budget.still_allowance(now_ns):
                break
            self._budget.record_still(size_bytes, now_ns=now_ns)
            self._line.send(Channel.ROI, self._ready, at_ns=now_ns)
            self._ready.clear()
        self.cpu_s += time.process_time() - began_s

    def _fill(self) -> None:
        while self._requested and sum(len(unit.data) for unit in self._ready) < self._settings.bundle_bytes:
            self._ready.append(self._code_next())

    def _code_next(self) -> AccessUnit:
        frame_index, blocks = self._requested.popleft()
        frame = self._stored.pop(frame_index)
        picture = pasted(None, frame.base_bgr, blocks, align_px=self._settings.align_px)
        unit = self._second.encode(replace(frame, base_bgr=picture), keyframe=not self._second_done)
        self._second_done = True
        return unit

    def _store(self, frame: Frame) -> None:
        self._stored[frame.index] = frame
        if len(self._stored) > self._most:
            oldest = min(self._stored)
            del self._stored[oldest]
            if self._requested and self._requested[0][0] == oldest:
                self._requested.popleft()

    def _is_requested(self, frame_index: int) -> bool:
        return any(frame_index == one for one, _ in self._requested)

    def _shrunk(self, frame: Frame) -> Image:
        if self._first_size == self._size:
            return frame.base_bgr
        return np.asarray(
            cv2.resize(frame.base_bgr, self._first_size, interpolation=cv2.INTER_AREA), np.uint8
        )
