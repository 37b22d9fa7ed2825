"""Whole pipelines in lockstep against the bare sum of their parts, on the same frames in the same run.

The floor of the edge is x265 encode, HEVC decode and a detector call on every fifth frame; of the ground, decode and
as many detector calls as it made, with the conversion of those pictures to BGR. A pipeline adds the source, tracking,
camera motion, methods, stills, headers, ledger and the recording, and may win time back by doing things side by side.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.bars import measured
from bench.support.material import FPS, SIZE, clip, encoder, frames, nano
from hvt_common import __version__
from hvt_common.inference.detect import open_detector, warm_up
from hvt_common.protocol.messages import BaseHeader, Flags, Info
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.process import limit_malloc_arenas, put_video_first
from hvt_common.transport.inbox import Received
from hvt_common.values import AccessUnit, View
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.config import GroundConfig
from hvt_ground.link.reassemble import Arrival
from hvt_ground.session.session import Session
from hvt_ground.sinks import QueuedSink
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_ground.sinks.rerun.sdk import leave_out_pandas
from hvt_ground.wiring import Models, SessionPerception

_FRAMES = 200
_EVERY = 5
_ROUNDS = 3


def rows() -> list[dict[str, object]]:
    for set_up in (limit_malloc_arenas, put_video_first, leave_out_pandas):  # as hvt-ground does
        set_up()
    taken = frames(_FRAMES)
    edge, ground, floor_edge, floor_ground = [], [], [], []
    for _ in range(_ROUNDS):
        encode_s, units = _bare_encode(taken)
        floor_edge.append(encode_s + _bare_analysis(units, searched=len(units) // _EVERY))
        edge.append(_edge())
        ground_s, searched = _ground(units)
        ground.append(ground_s)
        floor_ground.append(_bare_analysis(units, searched=searched))
    return [
        measured("edge, frames a second over its floor's", min(floor_edge) / min(edge)),
        measured("ground, frames a second over its floor's", min(floor_ground) / min(ground)),
        measured("edge floor, ms a frame", min(floor_edge) * 1e3),
        measured("ground floor, ms a frame", min(floor_ground) * 1e3),
    ]


def _bare_encode(taken) -> tuple[float, list[AccessUnit]]:
    coder = encoder()
    began = time.perf_counter()
    units = [coder.encode(frame) for frame in taken]
    return (time.perf_counter() - began) / len(taken), units


def _bare_analysis(units: list[AccessUnit], *, searched: int) -> float:
    decoder, detector = BaseDecoder(), open_detector(str(nano()), provider="auto")
    warm_up(detector, SIZE)
    due = {index * len(units) // searched for index in range(searched)}
    began = time.perf_counter()
    for index, unit in enumerate(units):
        picture = decoder.decode_yuv(unit.data)
        if index in due:
            detector.detect(picture.bgr())
    return (time.perf_counter() - began) / len(units)


def _edge() -> float:
    """Seconds a frame of hvt-edge in lockstep; start-up is taken off by running two lengths."""
    took = {}
    for count in (20, 20 + _FRAMES):
        command = [sys.executable, "-m", "hvt_edge.cli", "--source", clip(), "--detector", nano(), "--quiet"]
        command += ["--method", "M5", "--pace", "lockstep", "--wait", "0s", "--max-frames", str(count)]
        command += ["--connect", "tcp/127.0.0.1:9"]
        began = time.perf_counter()
        done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
        assert done.returncode == 1, "nobody listens"
        took[count] = time.perf_counter() - began
    return (took[20 + _FRAMES] - took[20]) / _FRAMES


def _ground(units: list[AccessUnit]) -> tuple[float, int]:
    """Seconds a frame of a lockstep session with its recording, and pictures searched; its detector is open."""
    info = _info()
    config = GroundConfig(detector=str(nano()), detect_every=_EVERY)
    models = Models(config)
    models.wait()
    items = [_received(sequence, unit) for sequence, unit in enumerate(units)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.rrd"
        sink = QueuedSink(
            "recording",
            lambda: Recorder(RecorderSettings.of(info, path)),
            failures=Failures(time.time_ns),
            wait_s=10.0,
        )
        session = Session(
            info,
            sinks=[sink],
            pipeline_of=SessionPerception(config, models, info).pipeline,
            clock=time.time_ns,
        )
        began = time.perf_counter()
        for number, (header, item) in enumerate(items):
            unit = Arrival("decode", header, item, item.received_ns, starts_run=number == 0)
            session.base(unit)
        while not session.idle:
            time.sleep(0.001)
        took = time.perf_counter() - began
        searched = session.perceived.detections_run
        session.close()
        sink.join(10.0)
    return took / len(items), searched


def _received(sequence: int, unit: AccessUnit) -> tuple[BaseHeader, Received]:
    header = BaseHeader(
        session_id=1,
        sequence=sequence,
        frame_index=unit.frame_index,
        capture_ns=unit.capture_ns,
        send_delay_ns=0,
        flags=Flags.LOCKSTEP | (Flags.KEYFRAME if unit.keyframe else 0),
    )
    return header, Received(
        "hvt/edge-1/base", unit.data, header.pack(unit.data), "video/h265", time.time_ns()
    )


def _info() -> Info:
    view = View.fitted(SIZE, SIZE, fit="letterbox")
    return Info(
        session_id=1, edge="edge-1", software=__version__, started_ns=0, source_size=SIZE, base_size=SIZE,
        view_scale=view.scale, view_offset_px=view.offset_px, fps=FPS, codec="hevc", pace="lockstep", method="M0",
        budget_bps=800_000, base_bps=650_000, window_ns=10**9, class_names=("car",), received_ns=0, answered_ns=0,
    )  # fmt: skip
