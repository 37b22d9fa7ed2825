"""Files from elsewhere: poses beside a clip, the log of another ground, and models."""

import contextlib
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hvt_archive.replay.message_log import MessageLog, read_log
from hvt_common.errors import UserError
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_common.transport.inbox import Received
from hvt_geo.pose.files import read_poses
from lab.fuzz.contract import Target, scratch
from media.onnx_models import colour_classifier, constant_model
from rigs import messages

_TABLE = (
    b"time_s,latitude_deg,longitude_deg,height_m,camera_yaw_deg,camera_pitch_deg,hfov_deg\n"
    b"0,48.1,11.5,120,90,-45,60\n1.5,48.1001,11.5002,121,91.5,-44,60\n"
)
_UTC_TABLE = (
    b"utc,latitude_deg,longitude_deg\n2026-05-01T10:00:00Z,48.1,11.5\n2026-05-01T10:00:01Z,48.1,11.6\n"
)
_SUBTITLES = (
    b'1\n00:00:00,000 --> 00:00:00,033\n<font size="28">SrtCnt : 1, DiffTime : 33ms\n2026-05-01 10:00:00.000\n'
    b"[focal_len: 24.00] [latitude: 48.1] [longitude: 11.5] [rel_alt: 12.3 abs_alt: 530.1] "
    b"[gb_yaw: 12.0 gb_pitch: -45.0 gb_roll: 0.0]</font>\n\n"
    b"2\n00:00:01,033 --> 00:00:01,066\nGPS(11.5,48.1,19) BAROMETER:12.3\n\n"
)
_TRACK = (
    b'<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1"><trk><trkseg>'
    b'<trkpt lat="48.1" lon="11.5"><ele>530</ele><time>2026-05-01T10:00:00Z</time></trkpt>'
    b'<trkpt lat="48.2" lon="11.5"><ele>531</ele><time>2026-05-01T10:00:01Z</time></trkpt>'
    b"</trkseg></trk></gpx>"
)


def _poses(suffix: str) -> Callable[[bytes], None]:
    def run(data: bytes) -> None:
        path = scratch() / f"poses{suffix}"
        path.write_bytes(data)
        with contextlib.suppress(UserError):
            table = read_poses(path, hfov_deg=60.0)
            pose = table.at(1_000_000_000, capture_ns=0)
            assert pose is None or (math.isfinite(pose.latitude_deg) and abs(pose.latitude_deg) <= 90)

    return run


def _log(data: bytes) -> None:
    path = scratch() / "flight.hvtlog"
    path.write_bytes(data)
    with contextlib.suppress(UserError):
        for item in read_log(path):
            assert type(item.key) is str
            assert type(item.payload) is bytes


def _log_seed() -> bytes:
    path = Path(scratch()) / "seed.hvtlog"
    log = MessageLog(path, most_bytes=10**9)
    for number, message in enumerate((messages.BASE, messages.STATUS, messages.INFO)):
        log.log(Received("hvt/uav-1/base", b"a unit", message.pack(), "video/h265", number))
    log.close()
    return path.read_bytes()


def _model(data: bytes) -> None:
    path = scratch() / "m.onnx"
    path.write_bytes(data)
    with contextlib.suppress(UserError):
        open_model(path, settings=ModelSettings(threads=1))


def _seeds() -> list[bytes]:
    small = constant_model(scratch() / "seed.onnx", np.ones((1, 2), np.float32), metadata={"names": "['a']"})
    return [small.read_bytes(), colour_classifier(scratch() / "seed.onnx").read_bytes()]


TARGETS = (
    Target("pose-table", _poses(".csv"), lambda: [_TABLE, _UTC_TABLE], share=10, short=300),
    Target("pose-subtitles", _poses(".srt"), lambda: [_SUBTITLES], share=10, short=300),
    Target("pose-track", _poses(".gpx"), lambda: [_TRACK], share=10, short=300),
    Target("message-log", _log, lambda: [_log_seed()], share=10, short=500),
    Target("model-file", _model, _seeds, share=8, short=200, most_bytes=2000),
)
