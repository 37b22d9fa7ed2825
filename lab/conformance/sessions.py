"""Vectors that are sessions: reports of tracks and poses that build on each other, some damaged, some missing."""

from collections.abc import Iterator
from dataclasses import astuple, replace
from typing import Any

import numpy as np

from hvt_common.protocol import messages as wire
from hvt_common.protocol.messages.bits import BitWriter
from hvt_common.protocol.messages.track_boxes import CodedTrack, read_tracks
from hvt_common.values import Orientation, Pose, Tracks
from lab.conformance.scripted import Step, pose_changes, track_sessions, whole_pose, written

_LONG = 100
_TRACK = (
    "id",
    "class",
    "confidence",
    "x",
    "y",
    "width",
    "height",
    "vx",
    "vy",
    "scale_x",
    "scale_y",
    "missed",
)


def track_steps() -> Iterator[dict[str, Any]]:
    """Sessions of steps, each with the list that it leaves; damaged ones leave that of the step before."""
    for name, count, steps in (("three cars", 3, 8), ("a crowd", 60, 6), ("nobody", 0, 3)):
        yield {"session": name, "steps": list(_session(count, steps))}
    again = _session(3, 2, session_id=2**63 + 6)  # of the same float
    yield {"session": "the edge starts again", "steps": [*_session(3, 3), *again]}
    yield {"session": "damaged steps", "steps": list(_damaged())}
    for name, script in track_sessions():
        yield {"session": name, "steps": list(_scripted(script))}


def _scripted(script: list[Step]) -> Iterator[dict[str, Any]]:
    """The list of a long step by its length alone."""
    state: list[CodedTrack] = []
    last = -1, -1
    for sequence, (frame, builds, numbers) in enumerate(script):
        before, frames = (state if builds else None), frame - last[1]
        boxes = written(numbers, reference=before, frames=frames)
        step = wire.TrackStep(
            session_id=1,
            sequence=sequence,
            frame_index=frame,
            capture_ns=10**18,
            send_delay_ns=0,
            reference=last[0] if builds else -1,
            boxes=boxes,
        )
        found: dict[str, Any] = {"hex": step.pack().hex()}
        try:
            state = read_tracks(boxes, reference=before, frames=frames)
        except wire.WireError:
            yield found | {"damaged": True}
            continue
        last = sequence, frame
        yield found | ({"tracks": _rows(state)} if len(state) < _LONG else {"count": len(state)})


def _session(count: int, steps: int, *, session_id: int = 2**63 + 5) -> Iterator[dict[str, Any]]:
    encoder = wire.TrackStepEncoder(session_id=session_id, refresh_ns=1_500_000_000)
    state: list[CodedTrack] = []
    frame = -1
    for number in range(steps):
        step = encoder.encode(_tracks(count, number), capture_ns=10**18 + number * 333_333_333)
        state = _read(step, state, before=frame)
        frame = step.frame_index
        yield {"hex": step.pack().hex(), "tracks": _rows(state)}


def _tracks(count: int, number: int) -> Tracks:
    """Objects that move, turn up, are missed for some steps, change their class and leave."""
    ids = [one for one in range(1, count + 1) if (one + number) % 4 or one % 3]
    ids += [10_000 + number] if count else []
    rng = np.random.default_rng(number)
    rows = np.array(ids, np.float64).reshape(-1, 1)
    corner = np.hstack([rows * 37 % 1200, rows * 23 % 680]) + number * np.hstack([rows % 5 - 2, rows % 3])
    corner += rng.normal(0, 0.5, corner.shape)
    side = np.hstack([8 + rows % 40, 6 + rows % 25])
    return Tracks(
        frame_index=number * 5,
        ids=np.array(ids, np.int64),
        boxes_xyxy_px=np.hstack([corner, corner + side]).astype(np.float32),
        confidences=(0.3 + rows[:, 0] * 7 % 10 / 15).astype(np.float32),
        class_ids=((rows[:, 0] + (number > 3)) % 4).astype(np.int32),
        born_frames=np.zeros(len(ids), np.int64),
        seen_frames=np.full(len(ids), number * 5, np.int64),
        started=np.zeros(len(ids), np.bool_),
    )


def _damaged() -> Iterator[dict[str, Any]]:
    encoder = wire.TrackStepEncoder(session_id=1)
    first = encoder.encode(_tracks(5, 0), capture_ns=10**18)
    second = encoder.encode(_tracks(5, 1), capture_ns=10**18 + 333_333_333)
    state = _read(first, [], before=-1)
    yield {"hex": first.pack().hex(), "tracks": _rows(state)}
    for boxes in (second.boxes[:-6], second.boxes + b"\0\0", bytes(40), b"\xff" * 40):
        step = replace(second, boxes=boxes)
        try:
            _read(step, state, before=first.frame_index)
        except wire.WireError:
            yield {"hex": step.pack().hex(), "damaged": True}
    for step in (second, replace(first, sequence=second.sequence)):
        yield {"hex": replace(step, frame_index=0).pack().hex(), "damaged": True}
    for frame_index in (second.frame_index, 0):
        lost = replace(second, sequence=9, reference=8, frame_index=frame_index)
        yield {"hex": lost.pack().hex(), "skipped": True}
    for skipped in (first, replace(second, coding=2)):
        yield {"hex": skipped.pack().hex(), "skipped": True}
    yield {"hex": second.pack().hex(), "tracks": _rows(_read(second, state, before=first.frame_index))}


def _read(step: wire.TrackStep, state: list[CodedTrack], *, before: int) -> list[CodedTrack]:
    reference = None if step.reference < 0 else state
    return read_tracks(step.boxes, reference=reference, frames=step.frame_index - before)


def _rows(state: list[CodedTrack]) -> list[dict[str, int]]:
    return [dict(zip(_TRACK, astuple(one), strict=True)) for one in state]


def poses() -> Iterator[dict[str, Any]]:
    """Sessions of reports; one that builds on a report that never came is skipped, a damaged one changes nothing."""
    camera = [Orientation(359.5 + second, -60.0 - second, 2.0 * second) for second in range(6)]
    flight = [
        Pose(
            (1_000 + second * 1_037) * 1_000_000,
            48.137 + 3e-5 * second,
            179.99997 + 1e-5 * second - (360 if second > 2 else 0),
            height_m=120.0 + second,
            altitude_m=640.5,
            camera=camera[second],
            platform=Orientation(350.0 + 4 * second, -3.0, 1.0),
            hfov_deg=65.0,
            position_error_m=3.0 if second < 4 else 8.0,
        )
        for second in range(6)
    ]
    place = [Pose((5_000 + 1_000 * second) * 1_000_000, -33.8568, 151.2153) for second in range(3)]
    encoder = wire.PoseEncoder(session_id=9)
    reports = [encoder.encode(one)(7) for one in flight]
    yield {"session": "across the antimeridian and north", "reports": list(_read_poses(reports))}
    encoder = wire.PoseEncoder(session_id=9)
    places = [encoder.encode(one)(7) for one in place]
    yield {"session": "a place and no more", "reports": list(_read_poses(places))}
    encoder = wire.PoseEncoder(session_id=9, refresh_ns=2_500_000_000)
    reports = [encoder.encode(one)(7) for one in flight]
    damaged = [
        replace(reports[1], coded=reports[1].coded[:-2]),
        replace(reports[1], coded=reports[1].coded + b"\0"),
        replace(reports[1], coded=b""),
    ]
    other = replace(reports[1], coding=2)
    holes = [reports[1], reports[0], *damaged, other, reports[1], reports[1], *reports[3:]]
    yield {"session": "holes, damage, and one that stands by itself", "reports": list(_read_poses(holes))}
    again = [replace(one, session=8) for one in (reports[1], reports[0], reports[1])]
    yield {"session": "the edge starts again", "reports": list(_read_poses([reports[0], *again]))}
    late = [
        replace(reports[0], send_ns=0),
        *(replace(reports[1], send_ns=ms * 10**6) for ms in (12_001, 12_000)),
    ]
    yield {"session": "sixteen are lost", "reports": list(_read_poses(late))}
    for name, scripts in _pose_scripts().items():
        made = [wire.PoseReport(session=9, send_ns=7, coded=one.ended(stop="")) for one in scripts]
        yield {"session": name, "reports": list(_read_poses(made))}


def _pose_scripts() -> dict[str, list[BitWriter]]:
    place = (481_370_000, -1_799_999_990)
    filled = whole_pose(0, 1000, place)
    filled.u(1, 3)  # in the bits that fill the last byte
    whole = whole_pose(1, 2000, place, yaw=0, field=650)  # it fills its last byte
    steep = [
        whole_pose(number, 1000 * number, place, yaw=0, pitch=pitch) for number, pitch in ((1, 900), (2, 901))
    ]
    return {
        "to the left, across the antimeridian and north": [
            whole_pose(14, 1000, place, yaw=5, pitch=-900),
            pose_changes(15, place=(0, -30), camera=(-7, 0, -5)),
            pose_changes(0, camera=(7, 1, 5)),
            pose_changes(1, camera=(0, -2, 0)),
            pose_changes(1, camera=(0, 1799, 0)),
            pose_changes(1, camera=(0, 1799, 1), errors=27),
            pose_changes(2, camera=(0, 0, 0), errors=1),
            pose_changes(2, camera=(0, 0, 0), errors=-31),
            pose_changes(3, camera=(0, 0, 0), errors=-1),
        ],
        "bits where zeros have to be": [filled, whole_pose(0, 1000, place), whole.u(0, 8)],
        "bounds": [
            *(whole_pose(0, 1000, (north, 5)) for north in (900_000_000, 900_000_001, -900_000_000)),
            *(whole_pose(0, 1000, (7, east)) for east in (-1_800_000_000, 1_799_999_999, 1_800_000_000)),
            *(whole_pose(0, 1000, place, yaw=yaw) for yaw in (3599, 3600)),
            *(whole_pose(0, 1000, place, field=field) for field in (1, 1799, 1800)),
            whole_pose(0, 1000, place),
            *(pose_changes(1, errors=more) for more in (28, 27)),
            *steep,
            *(whole_pose(3, 3000, place, yaw=0, roll=roll) for roll in (-1800, 1799, 1800)),
            *(whole_pose(4, 4000, (900_000_000, 5), height=height) for height in (1_000_001, 1_000_000)),
            *(pose_changes(5, place=(north, 0), height=0) for north in (1, -1)),
            *(pose_changes(6, height=higher) for higher in (1, 0)),
        ],
        "time goes on": [
            whole_pose(3, 5000, place),
            pose_changes(4, time_ms=0),
            pose_changes(4, time_ms=-5),
            pose_changes(4, time_ms=1),
            whole_pose(5, 2**42 - 2, place),
            pose_changes(6, time_ms=2),
            pose_changes(6, time_ms=1),
            whole_pose(7, 9, place),
        ],
    }


def _read_poses(reports: list[wire.PoseReport]) -> Iterator[dict[str, Any]]:
    decoder, session = wire.PoseDecoder(), reports[0].session
    for report in reports:
        if report.session != session:
            decoder, session = wire.PoseDecoder(), report.session
        found: dict[str, Any] = {"hex": report.pack().hex()}
        if report.coding != 1:
            yield found | {"skipped": True}
            continue
        try:
            pose = decoder.decode(report)
        except wire.WireError:
            yield found | {"damaged": True}
            continue
        yield found | ({"skipped": True} if pose is None else {"pose": _pose_numbers(pose)})


def _pose_numbers(pose: Pose) -> dict[str, Any]:
    """As they are coded; a missing value is null."""

    def tenths(*values: float) -> list[int]:
        return [round(10 * one) for one in values]

    angles = [
        None if one is None else tenths(one.yaw_deg, one.pitch_deg, one.roll_deg)
        for one in (pose.camera, pose.platform)
    ]
    parts = [
        None if one is None else tenths(one)[0] for one in (pose.height_m, pose.altitude_m, pose.hfov_deg)
    ]
    errors = (pose.position_error_m, pose.height_error_m, pose.angle_error_deg)
    return {
        "time_ms": pose.capture_ns // 1_000_000,
        "place": [round(1e7 * pose.latitude_deg), round(1e7 * pose.longitude_deg)],
        "height": parts[0],
        "altitude": parts[1],
        "camera": angles[0],
        "platform": angles[1],
        "field": parts[2],
        "errors": [round(2 * np.log2(10 * one)) for one in errors],
    }
