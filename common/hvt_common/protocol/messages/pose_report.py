"""The payload of ``pose``: where the camera was, in about 35 bytes. docs/wire-messages.md has it as a table.

A report that stands by itself holds everything in numbers of fixed length. The next ones hold differences from the
report before; for the place, the difference of differences, since a vehicle mostly keeps its velocity.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final

from hvt_common.protocol.messages.bits import BitReader, BitWriter
from hvt_common.protocol.messages.envelope import Message
from hvt_common.protocol.messages.fields import I63, U32, Blob, Int, WireError, wire_field
from hvt_common.values import Orientation, Pose

_MOST_BYTES: Final = 48
_MILLION: Final = 1_000_000
_NUMBERS: Final = 16
_MOST_PAUSE_NS: Final = 12_000_000_000
"""The longest time that an encoder goes on without a report that stands by itself; sixteen reports take longer."""
_ONE_SECOND_MS: Final = 1000
_TIME_BITS, _TIME_ORDER = 42, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseReport(Message):
    """Payload of ``pose``."""

    MAX_BYTES: ClassVar[int] = 80
    TRIMMED: ClassVar[bool] = True

    session: int = wire_field(Int(0, U32))
    """The lowest 32 bits of the session's id: four bytes less, and it is a session or the one before it."""
    send_ns: int = wire_field(Int(0, I63))
    """When the edge handed the message to Zenoh, its clock; media time in lockstep."""
    coded: bytes = wire_field(Blob(_MOST_BYTES))
    """Bits; see docs/wire-messages.md."""
    coding: int = wire_field(Int(1, 255), default=1)
    """1: as docs/wire-messages.md has it."""

    def is_of(self, session_id: int) -> bool:
        return self.session == session_id & U32

    @property
    def number(self) -> int:
        """The number of the report, modulo 16; 0 if it is empty, which `PoseDecoder.decode` refuses."""
        return self.coded[0] >> 3 & 15 if self.coded else 0


@dataclass(frozen=True, slots=True)
class _Number:
    low: int
    high: int
    order: int
    wraps: bool = False

    @property
    def bits(self) -> int:
        return (self.high - self.low).bit_length()

    def change(self, old: int, new: int) -> int:
        span = self.high - self.low + 1
        change = new - old
        return (change + span // 2) % span - span // 2 if self.wraps else change

    def changed(self, old: int, change: int) -> int:
        span = self.high - self.low + 1
        return self.checked((old + change - self.low) % span + self.low if self.wraps else old + change)

    def checked(self, value: int) -> int:
        if not self.low <= value <= self.high:
            raise WireError(f"a pose's number {value} is outside {self.low}…{self.high}")
        return value


_ANGLES: Final = (_Number(0, 3599, 3, wraps=True), _Number(-900, 900, 3), _Number(-1800, 1799, 3, wraps=True))
_PLACE: Final = (_Number(-900_000_000, 900_000_000, 5), _Number(-1_800_000_000, 1_799_999_999, 5, wraps=True))
_HEIGHT, _ALTITUDE = _Number(-10_000, 1_000_000, 2), _Number(-10_000, 1_000_000, 2)
_FIELD: Final = _Number(1, 1799, 0)
_ERRORS: Final = (_Number(0, 31, 0),) * 3
_PARTS: Final = ((_HEIGHT,), (_ALTITUDE,), _ANGLES, _ANGLES, (_FIELD,))
"""The optional parts: height, altitude, the camera's angles, the platform's, the field of view."""
_GROUPS: Final = (_PLACE, *_PARTS, _ERRORS)
_LEAST_ERROR, _ERROR_RATIO = 0.1, 2**0.5


@dataclass(frozen=True, slots=True)
class _Sample:
    time_ms: int
    place: tuple[int, ...]
    """Latitude and longitude, 1e-7 degrees."""
    parts: tuple[tuple[int, ...] | None, ...]
    """The values of `_PARTS`: 0.1 m and 0.1 degrees."""
    errors: tuple[int, ...]
    """The errors of place, height and angles: 0.1 m or degrees times the square root of 2 to this power."""

    @classmethod
    def of(cls, pose: Pose) -> _Sample:
        """Raises ValueError for a pose out of bounds."""
        camera, platform = (None if one is None else _angles(one) for one in (pose.camera, pose.platform))
        return cls(
            time_ms=round(pose.capture_ns / _MILLION),
            place=(
                _checked(round(pose.latitude_deg * 1e7), _PLACE[0], "latitude"),
                _wrapped(round(pose.longitude_deg * 1e7), _PLACE[1]),
            ),
            parts=(
                _tenths(pose.height_m, _HEIGHT, "height"),
                _tenths(pose.altitude_m, _ALTITUDE, "altitude"),
                camera,
                platform,
                _tenths(pose.hfov_deg, _FIELD, "field of view"),
            ),
            errors=tuple(
                _error_step(one) for one in (pose.position_error_m, pose.height_error_m, pose.angle_error_deg)
            ),
        )

    @property
    def presence(self) -> tuple[bool, ...]:
        return tuple(one is not None for one in self.parts)

    def pose(self) -> Pose:
        height, altitude, camera, platform, field = self.parts
        position, vertical, angle = (_LEAST_ERROR * _ERROR_RATIO**step for step in self.errors)
        return Pose(
            capture_ns=self.time_ms * _MILLION,
            latitude_deg=self.place[0] / 1e7,
            longitude_deg=self.place[1] / 1e7,
            height_m=None if height is None else height[0] / 10,
            altitude_m=None if altitude is None else altitude[0] / 10,
            camera=None if camera is None else Orientation(*(one / 10 for one in camera)),
            platform=None if platform is None else Orientation(*(one / 10 for one in platform)),
            hfov_deg=None if field is None else field[0] / 10,
            position_error_m=position,
            height_error_m=vertical,
            angle_error_deg=angle,
        )


class PoseEncoder:
    """Makes the reports of one session, one after the other.

    Each builds on the one before; one in ``refresh_ns`` of capture time stands by itself.
    """

    def __init__(self, *, session_id: int, refresh_ns: int = 10_000_000_000) -> None:
        self._session = session_id & U32
        self._refresh_ns = refresh_ns
        self._number = -1
        self._last: _Sample | None = None
        self._step: tuple[int, ...] = (0, 0)
        self._fresh_ns = 0

    def encode(self, pose: Pose) -> Callable[[int], PoseReport]:
        """The next report, to be made for its time of sending. ValueError for a pose out of bounds."""
        sample, last = _Sample.of(pose), self._last
        number = (self._number + 1) % _NUMBERS
        coded, alone = _whole(sample, number), True
        step: tuple[int, ...] = (0, 0)
        comparable = last is not None and last.presence == sample.presence and last.time_ms < sample.time_ms
        if last is not None and comparable and pose.capture_ns - self._fresh_ns < self._refresh_ns:
            changes, changed_step = _changes(sample, number, last=last, step=self._step)
            if len(changes) < len(coded):
                coded, step, alone = changes, changed_step, False
        if alone:
            self._fresh_ns = pose.capture_ns
        self._number, self._last, self._step = number, sample, step
        return lambda send_ns: PoseReport(session=self._session, send_ns=send_ns, coded=coded)


class PoseDecoder:
    """Reads the reports of one session."""

    def __init__(self) -> None:
        self._number = -1
        self._sent_ns = 0
        self._last: _Sample | None = None
        self._step: tuple[int, ...] = (0, 0)

    def decode(self, report: PoseReport) -> Pose | None:
        """The pose; None where the report before did not come. Times are whole milliseconds, errors rounded up.

        Raises `WireError` where the bits make no sense; the decoder is as it was before.
        """
        if report.coding != 1:
            raise WireError(f"a pose of coding {report.coding}, which is not known here")
        bits = BitReader(report.coded)
        alone, number = bits.u(1), bits.u(4)
        step: tuple[int, ...] = (0, 0)
        if alone:
            sample = _read_whole(bits)
        elif (
            self._last is None
            or number != (self._number + 1) % _NUMBERS
            or report.send_ns - self._sent_ns > _MOST_PAUSE_NS
        ):
            return None
        else:
            sample, step = _read_changes(bits, last=self._last, step=self._step)
        bits.finish()
        self._number, self._sent_ns, self._last, self._step = number, report.send_ns, sample, step
        return sample.pose()


def _whole(sample: _Sample, number: int) -> bytes:
    out = BitWriter().u(1, 1).u(number, 4).u(sample.time_ms, _TIME_BITS)
    for there in sample.presence:
        out.u(int(there), 1)
    for kinds, values in zip(_GROUPS, (sample.place, *sample.parts, sample.errors), strict=True):
        for kind, value in zip(kinds, values or (), strict=False):
            out.u(value - kind.low, kind.bits)
    return out.ended(stop="")


def _read_whole(bits: BitReader) -> _Sample:
    time_ms = bits.u(_TIME_BITS)
    presence = [bool(bits.u(1)) for _ in _PARTS]
    place, *parts, errors = (
        tuple(kind.checked(bits.u(kind.bits) + kind.low) for kind in kinds) if there else None
        for kinds, there in zip(_GROUPS, (True, *presence, True), strict=True)
    )
    assert place is not None, "only parts may be missing"
    assert errors is not None
    return _Sample(time_ms, place, tuple(parts), errors)


def _changes(
    sample: _Sample, number: int, *, last: _Sample, step: tuple[int, ...]
) -> tuple[bytes, tuple[int, ...]]:
    # The changes, as bytes; and the place's step, which the next report builds on.
    out = BitWriter().u(0, 1).u(number, 4)
    out.se(sample.time_ms - last.time_ms - _ONE_SECOND_MS, _TIME_ORDER)
    stepped = tuple(
        kind.change(old, new) for kind, old, new in zip(_PLACE, last.place, sample.place, strict=True)
    )
    for kind, new, old in zip(_PLACE, stepped, step, strict=True):
        out.se(new - old, kind.order)
    for kinds, before, after in zip(
        _GROUPS[1:], (*last.parts, last.errors), (*sample.parts, sample.errors), strict=True
    ):
        for kind, old, new in zip(kinds, before or (), after or (), strict=False):
            out.se(kind.change(old, new), kind.order)
    return out.ended(stop=""), stepped


def _read_changes(
    bits: BitReader, *, last: _Sample, step: tuple[int, ...]
) -> tuple[_Sample, tuple[int, ...]]:
    time_ms = last.time_ms + _ONE_SECOND_MS + bits.se(_TIME_ORDER)
    if not last.time_ms < time_ms < 1 << _TIME_BITS:
        raise WireError(f"a pose at {time_ms} ms follows one at {last.time_ms} ms")
    stepped = tuple(old + bits.se(kind.order) for kind, old in zip(_PLACE, step, strict=True))
    place = tuple(
        kind.changed(old, change) for kind, old, change in zip(_PLACE, last.place, stepped, strict=True)
    )
    *parts, errors = (
        before
        and tuple(kind.changed(old, bits.se(kind.order)) for kind, old in zip(kinds, before, strict=True))
        for kinds, before in zip(_GROUPS[1:], (*last.parts, last.errors), strict=True)
    )
    assert errors is not None, "only parts may be missing"
    return _Sample(time_ms, place, tuple(parts), errors), stepped


def _angles(one: Orientation) -> tuple[int, ...]:
    yaw, pitch, roll = (round(value * 10) for value in (one.yaw_deg, one.pitch_deg, one.roll_deg))
    return _wrapped(yaw, _ANGLES[0]), _checked(pitch, _ANGLES[1], "pitch"), _wrapped(roll, _ANGLES[2])


def _tenths(value: float | None, kind: _Number, name: str) -> tuple[int, ...] | None:
    return None if value is None else (_checked(round(value * 10), kind, name),)


def _wrapped(value: int, kind: _Number) -> int:
    return (value - kind.low) % (kind.high - kind.low + 1) + kind.low


def _checked(value: int, kind: _Number, name: str) -> int:
    if not kind.low <= value <= kind.high:
        raise ValueError(f"a {name} of {value / 10:g} tenths cannot be sent")
    return value


def _error_step(value: float) -> int:
    # The first step that is no less; the largest says: or more.
    return next((step for step in range(31) if _LEAST_ERROR * _ERROR_RATIO**step >= value * (1 - 1e-9)), 31)
