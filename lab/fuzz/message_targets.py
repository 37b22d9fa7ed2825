"""Every message of the wire, with its checksum kept right."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from random import Random

import numpy as np

from hvt_common.protocol import messages as wire
from hvt_common.protocol.channels import parse_key
from hvt_common.values import Orientation, Pose
from hvt_ground.backlog.assembly import backlog_content
from lab.fuzz.contract import Target
from lab.fuzz.mutate import Bytes, changed_parts, changed_values, joined, parted, plain, with_checksum
from rigs import messages
from rigs.flight import tracks_at

_NOW = 1_790_000_000_000_000_000

ROI = replace(messages.ROI, flags=int(wire.Flags.STORED), parameters={})
REQUESTS = tuple(
    wire.ControlRequest(session_id=0, command=command, arguments=arguments)
    for command, arguments in (
        ("keyframe", {}),
        ("still", {"track": 5, "at_ms": -500, "quality": 80}),
        ("still", {"x": 100, "y": 80, "w": 64.0, "h": 48, "frame": 3}),
        ("still-outcome", {"ask": 1}),
        ("tracks", {}),
        ("set-budget", {"bps": 500_000}),
        ("set-method", {"method": "M5"}),
        ("send-backlog", {}),
    )
)


def feedback(**changes: object) -> wire.Feedback:
    """A receiver report with something in every field."""
    return replace(messages.FEEDBACK, **changes)  # type: ignore[arg-type]


_UNITS = tuple(wire.BacklogUnit(n, _NOW + n * 66_666_667, n == 0, bytes([n]) * (20 + n)) for n in range(6))


def _parsed(message: type[wire.Message]) -> Callable[[bytes], None]:
    """Parse it; a parsed message can be sent again and means the same."""

    def run(data: bytes) -> None:
        try:
            value = message.parse(data)
        except wire.WireError:
            return
        if isinstance(value, wire.Info):
            value.view.to_base(np.zeros((1, 4), np.float32))
        if len(data) <= message.MAX_BYTES - 64:  # short floats come back long
            assert message.parse(value.pack()) == value

    return run


def _with_payload(message: type[wire.Message]) -> Callable[[bytes], None]:
    """Attachment and payload: bytes that are not those of the checksum never parse."""

    def run(data: bytes) -> None:
        attachment, payload = parted(data, least=2)[:2]
        with contextlib.suppress(wire.WireError):
            value = message.parse(attachment, payload)
            assert message.parse(value.pack(payload), payload) == value

    return run


def _with_changed_payload(data: bytes, rng: Random, raw: Bytes) -> bytes:
    """An attachment and its payload, either changed, and mostly sealed together again."""
    attachment, payload = parted(data, least=2)[:2]
    if rng.random() < 0.3:
        payload = raw(payload)
    changed = changed_values(attachment, rng, raw) if rng.random() < 0.8 else attachment
    if rng.random() < 0.85:
        changed = with_checksum(changed[:-5], payload)
    return joined([changed, payload])


def _track_steps(data: bytes) -> None:
    decoder = wire.TrackStepDecoder()
    for part in parted(data):
        with contextlib.suppress(wire.WireError):
            step = wire.TrackStep.parse(part)
            tracks = decoder.decode(step)
            if tracks is not None:
                assert np.isfinite(tracks.boxes_xyxy_px).all()
                assert len(tracks.ids) == len(set(tracks.ids.tolist())) <= 1024
        ahead = decoder.predicted(frame_index=2**32 - 1)
        assert ahead is None or np.isfinite(ahead.boxes_xyxy_px).all()


def _step_seeds() -> list[bytes]:
    seeds = []
    for count, refresh_ns in ((3, 0), (6, 1_000_000_000), (40, 1_000_000_000)):
        encoder = wire.TrackStepEncoder(session_id=5, refresh_ns=refresh_ns)
        steps = [
            encoder.encode(
                tracks_at(
                    index,
                    {n + 1: (20.0 * n + index, 10.0, 20.0 * n + 16 + index, 30.0) for n in range(count)},
                ),
                capture_ns=_NOW + index * 66_666_667,
            ).pack()
            for index in (1, 2, 5)
        ]
        seeds += [joined(steps), joined(steps[:1])]
    return seeds


def _pose_reports(data: bytes) -> None:
    decoder = wire.PoseDecoder()
    for part in parted(data):
        with contextlib.suppress(wire.WireError):
            pose = decoder.decode(wire.PoseReport.parse(part))
            assert pose is None or (abs(pose.latitude_deg) <= 90 and abs(pose.longitude_deg) <= 180)


def _pose_seeds() -> list[bytes]:
    encoder = wire.PoseEncoder(session_id=5)
    reports = [
        encoder.encode(
            Pose(
                _NOW + second * 1_000_000_000,
                latitude_deg=48.1 + second * 1e-4,
                longitude_deg=179.9999 + second * 1e-4,
                height_m=120.0,
                camera=Orientation(90.0, -45.0, 0.0),
                hfov_deg=60.0,
            )
        )(_NOW).pack()
        for second in range(4)
    ]
    return [joined(reports), joined(reports[:1])]


def _backlog_still(data: bytes) -> None:
    with contextlib.suppress(wire.WireError):
        still = wire.parse_backlog_still(data)
        assert wire.parse_backlog_still(wire.pack_backlog_still(still)) == still
        backlog_content((ROI.session_id, wire.BacklogKind.STILL, ROI.sequence), data, edge="uav-1")


def _backlog_units(data: bytes) -> None:
    with contextlib.suppress(wire.WireError):
        units = wire.parse_backlog_units(data)
        assert wire.parse_backlog_units(wire.pack_backlog_units(units)) == units
        backlog_content((ROI.session_id, wire.BacklogKind.BASE, 0), data, edge="uav-1")


def _key(data: bytes) -> None:
    text = data.decode("utf-8", "surrogateescape")
    found = parse_key(text)
    assert found is None or f"hvt/{found[0]}/{found[1]}" == text


def _message(
    name: str, message: type[wire.Message], seeds: Sequence[wire.Message], *, share: int = 40
) -> Target:
    return Target(
        name,
        _parsed(message),
        lambda: [one.pack() for one in seeds],
        mutate=changed_values,
        share=share,
        most_bytes=message.MAX_BYTES + 64,
    )


def _streamed(name: str, message: type[wire.Message], seed: wire.Message) -> Target:
    payload = b"\0\0\0\1 payload"
    return Target(
        name,
        _with_payload(message),
        lambda: [joined([seed.pack(payload), payload])],
        mutate=_with_changed_payload,
        share=40,
        most_bytes=message.MAX_BYTES + 256,
    )


def _backlog_still_seeds() -> list[bytes]:
    payload = plain(Random(1))(b"\xff\xd8\xff" + bytes(40))
    return [wire.pack_backlog_still(wire.BacklogStill(ROI.pack(payload), "image/jpeg", payload))]


TARGETS = (
    _streamed("base-header", wire.BaseHeader, messages.BASE),
    _streamed("roi-header", wire.RoiHeader, ROI),
    _streamed("backlog-header", wire.BacklogHeader, messages.BACKLOG),
    _message("status", wire.Status, [messages.STATUS]),
    _message("info", wire.Info, [messages.INFO]),
    _message("info-request", wire.InfoRequest, [messages.INFO_REQUEST]),
    _message("control-request", wire.ControlRequest, REQUESTS),
    _message("control-answer", wire.ControlAnswer, [messages.ANSWER]),
    _message("feedback", wire.Feedback, [feedback(), feedback(stills=(), backlog=(), missing_stills=())]),
    Target("track-steps", _track_steps, _step_seeds, changed_parts, share=60, short=250, most_bytes=6000),
    Target("pose-reports", _pose_reports, _pose_seeds, changed_parts, share=40, short=500),
    Target("backlog-still", _backlog_still, _backlog_still_seeds, share=40),
    Target(
        "backlog-units",
        _backlog_units,
        lambda: [wire.pack_backlog_units(_UNITS), wire.pack_backlog_units(_UNITS[:1])],
        share=40,
    ),
    Target("key", _key, lambda: [b"hvt/uav-1/base", b"hvt/a/alive", b"hvt//roi"], share=30, most_bytes=256),
)
