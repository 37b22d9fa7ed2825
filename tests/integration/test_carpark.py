"""A real drone clip from camera to recording: two processes, real detectors, and a third party that listens."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import zenoh

from hvt_common.inference.class_names import group_of
from hvt_common.protocol.messages import Info, RoiHeader
from hvt_common.video.hevc import BaseDecoder
from programs.outsider import Message, Tap, answer, joined
from programs.processes import Link, eventually
from programs.rrd import Recording

pytestmark = [pytest.mark.nightly, pytest.mark.integration, pytest.mark.realdata]

FRAMES = 220
"""351 frames at 24 fps are 14.625 s: instants 0 … 219 at 15 fps."""


@dataclass(frozen=True)
class Flight:
    """What one run leaves behind, on all three sides."""

    edge: dict[str, Any]
    ground: dict[str, Any]
    recording: Recording
    recording_bytes: int
    base_file: Path
    info: Info
    stills: list[Message]


@pytest.fixture(scope="module")
def flight(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """drone_carpark at the default budget, M5, the VisDrone detector on both sides, ImageNet at the ground.

    The edge starts first and waits; the third party joins, then the ground.
    """
    folder = tmp_path_factory.mktemp("carpark")
    detector = str(data / "models/yolov5su_visdrone_640.onnx")
    with Link(folder) as link:
        edge = link.edge(
            *("--source", str(data / "clips/drone_carpark.mp4"), "--edge-id", "uav-1", "--method", "M5"),
            *("--pace", "lockstep"),
            *("--detector", detector, "--record-base", "base.mkv", "--wait", "60s"),
            listens=True,
        )
        with joined(link.edge_endpoint) as third:
            # Only `roi`: what waits for a ground waits for one that wants everything.
            tap = Tap(third, "hvt/uav-1/roi")
            info = wait_for_info(third)
            ground = link.ground(
                *("--once", "--record", "flight.rrd", "--detector", detector),
                *("--classifier", str(data / "models/mobilenet_v2_imagenet.onnx")),
                *("--labels", str(data / "models/imagenet_labels_1001.txt")),
            )
            summaries = edge.finish(), ground.finish()
            stills = tap.messages
    file = folder / "flight.rrd"
    return Flight(
        *summaries,
        recording=Recording(file),
        recording_bytes=file.stat().st_size,
        base_file=folder / "base.mkv",
        info=info,
        stills=stills,
    )


def wait_for_info(session: zenoh.Session) -> Info:
    """The edge's answer, as soon as it is there; then all that was declared before the question is known to it."""
    answers = []

    def answered() -> bool:
        answers.append(answer(session, "hvt/uav-1/info"))
        return answers[-1] is not None

    eventually(answered, what="the edge answers info")
    return Info.parse(answers[-1])


def test_every_frame_is_decoded(flight):
    """The operator would see a stutter, or nothing, on a link that loses nothing."""
    assert flight.edge["frames"] == FRAMES
    assert flight.edge["frames_dropped"] == 0
    assert flight.ground["frames"] == flight.ground["frames_decoded"] == FRAMES
    for counter in ("gaps", "lost", "corrupt", "duplicates", "unusable_messages", "frames_untracked"):
        assert flight.ground[counter] == 0, counter
    assert flight.edge["unusable_messages"] == 0


def test_both_ledgers_are_equal_to_the_byte(flight):
    """One side's account of the link would be wrong, and nobody could say which."""
    assert flight.edge["session"] == flight.ground["session"]
    for name in ("base_bytes", "roi_bytes", "meta_bytes", "overhead_bytes"):
        assert flight.edge[name] == flight.ground[name] > 0, name
    for name in ("total_bps", "base_bps", "roi_bps", "worst_window_bps", "duration_s", "budget_bps"):
        assert flight.edge[name] == flight.ground[name], name
    assert flight.edge["stills"]["sent"] == flight.ground["stills"]["received"] == len(flight.stills)
    assert flight.edge["roi_bytes"] == sum(len(still.payload) for still in flight.stills)


def test_the_budget_is_used_and_held(flight):
    """The link would be overrun for a second, or half of it paid for and not used."""
    edge = flight.edge
    assert edge["budget_bps"] == 800_000
    assert edge["worst_window_bps"]["total"] <= 800_000
    assert 0.9 * 800_000 <= edge["total_bps"] <= 800_000
    assert edge["base_bps"] <= 1.02 * edge["budget_base_bps"]


def test_a_network_of_photographs_makes_no_car_anything_else(flight):
    """Cars would be revolvers and waffle irons: a car from above is none of the thousand things that it knows."""
    assert flight.edge["stills"]["sent"] >= 50
    assert flight.ground["tracks"] >= 40
    shown = Counter(
        (box.class_before, box.class_after)
        for frame in range(0, FRAMES, 5)
        for box in flight.recording.boxes(frame).values()
    )
    vehicles = {pair: count for pair, count in shown.items() if group_of(pair[0]) == "vehicle"}
    assert sum(vehicles.values()) >= 1000
    assert {after for _, after in vehicles if group_of(after) != "vehicle"} == set()
    stills = flight.ground["stills"]
    assert stills["dropped"] == 0
    assert sum(stills["reasons"]["outcomes"].values()) >= stills["received"], (
        "one of each object that it shows"
    )
    notes = [
        text for _, _, text in flight.recording.events() if re.match(r"still #.*: \w+ \(.+ \.\d\d\)  ", text)
    ]
    assert len(notes) >= 0.5 * len(flight.stills), "what it called them stands beside the still"


def test_the_recording_holds_the_flight(flight):
    """Opening the file afterwards would show less than the operator saw."""
    recording = flight.recording
    assert recording.timelines == {"frame", "capture_time"}
    assert recording.blueprints >= 1
    assert [frame for frame, _, _ in recording.video()] == list(range(FRAMES))
    assert len(recording.stills()) == flight.ground["stills"]["received"]
    assert sorted(still for _, still in recording.stills()) == sorted(s.payload for s in flight.stills)
    tracks = [recording.boxes(frame) for frame in range(30, FRAMES, 10)]
    assert all(len(boxes) >= 20 for boxes in tracks)
    last = tracks[-1].values()
    wide, high = flight.info.base_size
    assert all(0 <= box.box_px[0] < box.box_px[2] <= wide and box.box_px[3] <= high for box in last)
    texts = [text for _, _, text in recording.events()]
    assert sum(text.startswith("still #") for text in texts) == len(flight.stills)
    assert recording.lines("/link/bitrate")


def test_the_recording_costs_about_what_the_link_carried(flight):
    """An hour of flight would fill the disk."""
    ground = flight.ground
    received = sum(ground[name] for name in ("base_bytes", "roi_bytes", "meta_bytes", "overhead_bytes"))
    assert flight.recording_bytes == ground["recording_bytes"]
    assert flight.recording_bytes <= 1.5 * received


def test_any_hevc_decoder_plays_what_was_recorded(flight):
    """The viewer would show garbage: it, too, gets nothing but these samples."""
    decoder = av.CodecContext.create("hevc", "r")
    decoder.thread_type = "SLICE"
    for _, _, unit in flight.recording.video():
        (picture,) = decoder.decode(av.Packet(unit))
        assert (picture.width, picture.height) == (1100, 720), "the source's own size: nothing is enlarged"


def test_the_base_file_is_the_stream(flight):
    """What was kept on the drone would not be what the ground saw."""
    base = flight.edge["base_bytes"]
    with av.open(str(flight.base_file)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "hevc"
        assert float(stream.average_rate) == pytest.approx(15, rel=0.01)
        times = [float(frame.pts * frame.time_base) for frame in container.decode(stream)]
    assert times == pytest.approx([index / 15 for index in range(FRAMES)], abs=0.001)
    assert base < flight.base_file.stat().st_size < 1.03 * base


def test_every_still_is_closer_to_the_source_than_the_base_crop(flight, data):
    """A still would cost bits and show less than the video already does."""
    by_frame = defaultdict(list)
    for message in flight.stills:
        by_frame[RoiHeader.parse(message.attachment, message.payload).frame_index].append(message)
    left, top = (round(offset) for offset in flight.info.view_offset_px)
    assert flight.info.view_scale == 1.0, "a source pixel is a base pixel here"
    decoder, gains_db = BaseDecoder(), []
    units = (unit for _, _, unit in flight.recording.video())
    source = sampled(data / "clips/drone_carpark.mp4", fps=15)
    for index, (unit, picture) in enumerate(zip(units, source, strict=True)):
        base = decoder.decode(unit)
        for message in by_frame[index]:
            x1, y1, x2, y2 = RoiHeader.parse(message.attachment, message.payload).crop_source_px
            truth = picture[y1:y2, x1:x2]
            seen = base[top + y1 : top + y2, left + x1 : left + x2]
            still = cv2.imdecode(np.frombuffer(message.payload, np.uint8), cv2.IMREAD_COLOR)
            assert still.shape == truth.shape == seen.shape
            gains_db.append(psnr(still, truth) - psnr(seen, truth))
    assert len(gains_db) == len(flight.stills)
    assert min(gains_db) > 0
    assert np.mean(gains_db) > 1


def sampled(clip: Path, *, fps: int) -> Iterator[np.ndarray]:
    """The clip's frames at instants k / fps: at each the latest one, as PyAV decodes them."""
    with av.open(str(clip)) as container:
        stream = container.streams.video[0]
        stamped = ((frame.pts * frame.time_base, frame) for frame in container.decode(stream))
        zero, shown = next(stamped)
        index = 0
        for at, frame in chain(stamped, [(zero + stream.duration * stream.time_base, None)]):
            picture = None
            while Fraction(index, fps) < at - zero:
                picture = shown.to_ndarray(format="bgr24") if picture is None else picture
                yield picture
                index += 1
            shown = frame


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB, over all channels."""
    error = np.mean((image.astype(np.float64) - truth) ** 2)
    return float(10 * np.log10(255**2 / max(error, 1e-9)))
