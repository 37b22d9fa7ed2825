"""An edge whole, with real x265 and Zenoh, on a source that no command line has."""

import itertools
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import pytest

from hvt_common.errors import FlightError, UserError
from hvt_common.inference.detect import Detector
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import Status
from hvt_common.runtime.reporting import reported
from hvt_common.values import Detections, Frame
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig, check
from hvt_edge.link.publisher import EdgeLink
from hvt_edge.source.contract import Source
from hvt_edge.world import World
from media.pictures import write_scene
from rigs.world import PassedOn

pytestmark = pytest.mark.integration

FPS, READING_S, FRAMES = 15.0, 0.5, 8


class Staged(World):
    """Calls ``before`` with each frame of its source; keeps its status messages, and counts opened detectors."""

    def __init__(self, before: Callable[[Frame], None] = lambda _frame: None) -> None:
        super().__init__()
        self.before, self.opened = before, 0
        self.reports: list[Status] = []

    def open_link(self, stack: ExitStack, config: EdgeConfig) -> EdgeLink:
        link = super().open_link(stack, config)
        put = link.put

        def noted(channel: Channel, payload: bytes, **more) -> None:
            if channel is Channel.STATUS:
                self.reports.append(Status.parse(payload))
            put(channel, payload, **more)

        link.put = noted
        return link

    def open_source(self, config: EdgeConfig) -> Source:
        return PassedOn(super().open_source(config), before=self.before)

    def open_detector(self, config: EdgeConfig) -> Detector:
        self.opened += 1
        return super().open_detector(config)


def edge(folder, world: World, *, frames: int = FRAMES, stop=None, **settings: Any) -> Edge:
    """An edge of so many pictures, to which nobody listens."""
    write_scene(folder, frames=frames)
    plain = {"source_fps": FPS, "fps": FPS, "size": "320x192", "preset": "ultrafast", "method": "M0"}
    plain |= {"connect": ("tcp/127.0.0.1:9",), "wait": 0.0, "quiet": True, "store": 0}
    config = check(EdgeConfig(source=str(folder), **(plain | settings)))
    return Edge(config, stop=stop or threading.Event(), world=world)


def test_a_clip_that_this_machine_cannot_play_in_time_is_played_slower(tmp_path):
    """The summary would tell of rates that never were."""
    began_s = time.monotonic()
    summary = edge(tmp_path, Staged(lambda _frame: time.sleep(READING_S))).run()
    took_s = time.monotonic() - began_s
    assert FRAMES * (READING_S - 1 / FPS) - 1.5 <= summary["clip_paused_s"] <= took_s
    assert FRAMES * READING_S - 2 <= summary["duration_s"] <= took_s
    assert summary["frames_captured"] == FRAMES


def test_a_link_is_mended_while_a_clip_waits_for_its_ground_and_sends_its_store(tmp_path):
    """No ground could have come any more: a deaf listener was made anew with pictures alone."""
    mended, stop = list[str](), threading.Event()

    class Alone(Staged):
        phase = "waits"

        def open_link(self, stack: ExitStack, config: EdgeConfig) -> EdgeLink:
            link = super().open_link(stack, config)
            link.mend, link.has_ground = self.mend, lambda: self.phase == "plays"
            return link

        def open_source(self, config: EdgeConfig) -> Source:
            source = super().open_source(config)
            frames = source.frames
            source.frames = lambda **at: self.play(frames(**at))
            return source

        def play(self, frames: Iterable[Frame]) -> Iterator[Frame]:
            self.phase = "plays"
            yield from frames
            self.phase = "is over"

        def mend(self) -> None:
            mended.append(self.phase)
            if self.phase == "is over":
                stop.set()

    edge(tmp_path, Alone(), wait=0.1, store=64 << 20, store_folder=tmp_path / "store", stop=stop).run()
    assert mended[0] == "waits"
    assert mended.count("is over") == 2, "while it sends, and with the last report"


def test_an_edge_that_hangs_is_reported(tmp_path):
    """All that was counted would be lost with it, and the reason; and a small board has no memory for threads."""
    hung, goes_on = threading.Event(), threading.Event()

    def before(frame: Frame) -> None:
        if frame.index == 3:
            hung.set()
            goes_on.wait()

    hanging = edge(tmp_path, Staged(before))
    assert hanging.given_up().summary is None, "nothing is known yet"
    run, there = threading.Thread(target=hanging.run), set(threading.enumerate())
    run.start()
    try:
        assert hung.wait(60)
        names = {one.name for one in {*threading.enumerate()} - there - {run}}
        own = {one for one in names if one.startswith("hvt-")}
        assert own <= {"hvt-link-watch", "hvt-sockets", "hvt-stills"}
        assert len(names) <= 6, "and one of Zenoh's for each channel that it answers on"
        summary = hanging.given_up().summary
    finally:
        goes_on.set()
        run.join()
    assert summary["frames_captured"] == 3
    assert "hangs" in next(one["reason"] for one in summary["failed"] if one["part"] == "flight")


@pytest.mark.parametrize(
    ("settings", "opened"),
    [
        ({"pace": "lockstep"}, 0),
        ({}, 0),
        ({"send_tracks": True}, 1),
        ({"method": "M2", "pace": "lockstep"}, 1),
    ],
)
def test_video_alone_opens_no_detector(tmp_path, settings, opened):
    """A third of the processor would go to tracks that nobody is sent."""
    world = Staged()
    summary = edge(tmp_path, world, **settings).run()
    assert (world.opened, summary["frames"] > 0, summary.get("failed") or None) == (opened, True, None)


def test_a_wrong_endpoint_is_refused_before_a_model_is_opened(tmp_path):
    """A board opens its models for half a minute, and then said what was wrong with the command."""
    world = Staged()
    with pytest.raises(UserError, match="is not usable: PROTOCOL"):
        edge(tmp_path, world, method="M2", connect=("tcp/127.0.0.1",)).run()
    assert world.opened == 0


def test_a_flight_that_breaks_off_is_reported_all_the_same(tmp_path, caplog):
    """Table and --summary of an hour were lost with the last second."""

    def before(frame: Frame) -> None:
        if frame.index == 6:
            raise UserError("it is torn")

    told, world = [], Staged(before)
    with pytest.raises(FlightError, match="it is torn"):
        reported(edge(tmp_path, world, pace="lockstep").run, told.append)
    (summary,), last = told, world.reports[-1]
    assert (last.state, [one.reason for one in last.failed]) == ("ended", ["it is torn"]), "the ground hears"
    assert summary["frames"] == 6
    assert [(one["part"], one["reason"]) for one in summary["failed"]] == [("flight", "it is torn")]
    assert "all else goes on" not in caplog.text


class FragileDetector(Detector):
    """Its first fails in flight; the next says whether that one is gone."""

    class_names = ("car",)

    def __init__(self, first: "weakref.ref[FragileDetector] | None", stop: threading.Event) -> None:
        self.first, self.runs, self._stop = first, 0, stop
        self.alone: bool | None = None

    def detect(self, image_bgr):
        self.runs += 1
        if self.first is None and self.runs > 2:
            raise RuntimeError("it stumbles")
        if self.first is not None:
            self.alone = self.first() is None
            self._stop.set()
        return Detections.none()


class EndlessSource(PassedOn):
    """The first frame of another, again and again."""

    def frames(self, *, start_ns: int):
        first = next(iter(self._inner.frames(start_ns=start_ns)))
        for index in itertools.count():
            yield replace(first, index=index, capture_ns=start_ns + round(index * 1e9 / self.fps))


class FragileWorld(World):
    """With such detectors; the flight ends when the second has looked, and not before."""

    def __init__(self) -> None:
        super().__init__()
        self.stop = threading.Event()
        self.first: weakref.ref[FragileDetector] | None = None
        self.second: FragileDetector | None = None

    def open_source(self, config: EdgeConfig) -> Source:
        return EndlessSource(super().open_source(config), before=lambda _frame: None)

    def open_detector(self, config: EdgeConfig) -> Detector:
        opened = FragileDetector(self.first, self.stop)
        if self.first is None:
            self.first = weakref.ref(opened)
        else:
            self.second = opened
        return opened


def test_a_detector_that_failed_does_not_stay_beside_its_successor(tmp_path):
    """The edge would hold two networks from the first failure on, 100 MB more, and a small board end it."""
    world = FragileWorld()
    edge(tmp_path, world, stop=world.stop, frames=2, method="M2", detect_every=1).run()
    assert world.second is not None, "it was opened again"
    assert world.second.alone


class CompilingWorld(World):
    """Its detector is open once somebody says so."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.go_on = threading.Event(), threading.Event()

    def open_detector(self, config: EdgeConfig) -> Detector:
        self.begun.set()
        assert self.go_on.wait(timeout=200)
        return super().open_detector(config)


@pytest.mark.parametrize("detector", ["motion", "aerial-nano"])
def test_an_edge_can_be_stopped_while_a_runtime_compiles(tmp_path, detector):
    """Ctrl-C did nothing for as long as that takes, minutes for some networks and boards."""
    world, stop = CompilingWorld(), threading.Event()
    with ThreadPoolExecutor(1) as pool:
        flight = pool.submit(edge(tmp_path, world, stop=stop, method="M2", detector=detector).run)
        try:
            assert world.begun.wait(timeout=200)
            stop.set()
            summary = flight.result(timeout=100)
        finally:
            world.go_on.set()
    assert summary["frames"] == 0
    assert not summary.get("failed")
