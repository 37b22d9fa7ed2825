"""An edge as a real process, whose camera fails, or whose machine is slow; whoever listens is plain Zenoh.

Disk, model, viewer and link are lost in `lab.failures`, which the nightly run flies.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from hvt_common.protocol.messages import BaseHeader, FailedPart, Flags, Status
from media.onnx_models import slow_detector
from programs.outsider import Tap, joined
from programs.processes import Link, Running, eventually
from programs.rtsp_camera import RtspCamera

pytestmark = [pytest.mark.nightly, pytest.mark.integration]

SMALL = ("--size", "320x192", "--fps", "10", "--preset", "ultrafast", "--budget", "400kbps")


class Watcher:
    """A program that subscribes to the video, and by the way to status, and never reports anything."""

    def __init__(self, session) -> None:
        self._base = Tap(session, "hvt/edge-1/base")
        self._status = Tap(session, "hvt/edge-1/status")

    @property
    def units(self) -> list[BaseHeader]:
        return [BaseHeader.parse(one.attachment, one.payload) for one in self._base.messages]

    @property
    def status(self) -> Status:
        return Status.parse(self._status.messages[-1].payload)

    def failed(self, name: str) -> FailedPart | None:
        parts = self.status.failed if self._status.messages else ()
        return next((one for one in parts if one.part == name), None)

    def goes_on(self, *, frames: int = 15) -> None:
        before = len(self._base.messages)
        eventually(lambda: len(self._base.messages) >= before + frames, what="video goes on")


@contextmanager
def watched(link: Link, *settings: str) -> Iterator[tuple[Running, Watcher]]:
    edge = link.edge("--wait", "0s", *SMALL, *settings, listens=True)
    with joined(link.edge_endpoint) as session:
        watcher = Watcher(session)
        eventually(lambda: watcher.units or not edge.alive, what="video")
        yield edge, watcher


def pictures(folder: Path, levels: list[int]) -> Path:
    """A folder of textured pictures, each of its own brightness."""
    folder.mkdir()
    noise = np.random.default_rng(1).integers(0, 40, (192, 320, 3))
    for index, level in enumerate(levels):
        picture = np.roll(noise, 3 * index, axis=1) + level
        cv2.imwrite(str(folder / f"{index:04d}.png"), np.clip(picture, 0, 255).astype(np.uint8))
    return folder


def test_a_camera_that_comes_back_begins_with_a_keyframe(link, free_port):
    """The operator would look at smear after each loose contact, or never learn why the picture stands.

    Nor is the flight stored for somebody who listens and reports nothing, as a plain Zenoh program does.
    """
    camera = RtspCamera(free_port)
    settings = ("--detector", "motion", "--store", "20MB", "--store-folder", "store")
    try:
        with watched(link, "--source", camera.url, *settings) as (edge, watcher):
            watcher.goes_on(frames=5)
            camera.close()
            eventually(lambda: watcher.failed("source"), what="status says so, without a frame")
            assert not watcher.failed("source").working
            count = len(watcher.units)
            camera = RtspCamera(free_port)
            eventually(lambda: len(watcher.units) > count + 5, what="video comes back")
            eventually(lambda: watcher.failed("source").working, what="status says so")
            assert watcher.units[count].flags & Flags.KEYFRAME
            edge.stop()
    finally:
        camera.close()
    summary = edge.summary()
    assert summary["failed"][0]["part"] == "source"
    assert summary["frames_stored"] <= watcher.units[0].frame_index + 1, (
        "but what came before anybody watched"
    )
    assert summary["total_bps"] <= 400_000


def test_on_a_slow_machine_perception_gives_way_to_video(link, tmp_path):
    """The picture would stutter because a detector wants the processor."""
    scene = pictures(tmp_path / "clip", [90] * 100)
    model = slow_detector(tmp_path / "model.onnx")
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})  # the edge inherits it
    try:
        edge = link.edge(
            *("--source", str(scene), "--wait", "0s", "--store", "0", "--preset", "ultrafast"),
            *("--size", "1280x720", "--fps", "20", "--detect-every", "1"),
            *("--detector", str(model), "--provider", "cpu"),
        )
    finally:
        os.sched_setaffinity(0, cores)
    summary = edge.finish()
    skipped = summary["frames_unanalyzed"]
    assert skipped > 0, "no core runs that model twenty times a second"
    # However little of the core others leave.
    analyzed = summary["frames_captured"] - summary["frames_dropped"] - skipped
    assert summary["frames"] >= max(1, min(90, 1.25 * analyzed))
    assert min(summary["cores_needed"], summary["cores_free"]) > 0
    assert f"{skipped} of {summary['frames_captured']} frames not analyzed" in edge.told
