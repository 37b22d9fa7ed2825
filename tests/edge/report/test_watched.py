"""An edge that is watched: what Prometheus, a probe and systemd learn while it flies, waits and hangs."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from hvt_common.inference.detect import Detector
from hvt_common.values import Detections, Frame, Image
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig, check
from hvt_edge.source.contract import Source
from hvt_edge.world import World
from programs.processes import Link, eventually, free_ports
from programs.rtsp_camera import RtspCamera

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

SMALL = ("--fps", "5", "--size", "320x192", "--detector", "motion", "--edge-id", "uav-1")


def asked(address: str, path: str) -> tuple[int, str]:
    """Status and text; 0 while nobody answers."""
    try:
        with urllib.request.urlopen(f"http://{address}{path}", timeout=10) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()
    except OSError:
        return 0, ""


def state(address: str) -> dict:
    """The newest; empty while there is none."""
    code, text = asked(address, "/state.json")
    return json.loads(text) if code == 200 else {}


def series(address: str) -> dict[str, float]:
    """Values by name; of several with one name the sum."""
    found: dict[str, float] = {}
    for family in text_string_to_metric_families(asked(address, "/metrics")[1]):
        for one in family.samples:
            found[one.name] = found.get(one.name, 0) + one.value
    return found


def status(*arguments: str) -> subprocess.CompletedProcess[str]:
    """``hvt-edge status``."""
    command = [sys.executable, "-m", "hvt_edge.cli", "status", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture
def address() -> str:
    """Where an edge answers."""
    return f"127.0.0.1:{free_ports(1)[0]}"


def test_an_edge_says_how_it_is_from_its_start_to_its_flight(tmp_path, address, long_scene):
    """A team would learn of an edge only what reaches the ground."""
    with Link(tmp_path) as link:
        store = ("--store", "20MB", "--store-folder", str(tmp_path / "store"))
        edge = link.edge("--source", str(long_scene), "--wait", "60", "--metrics", address, *SMALL, *store)
        eventually(lambda: state(address), within_s=60, what="it answers")
        waits = state(address)
        assert (waits["state"], waits["frames"]["account"]["came"]) == ("waiting", 0)
        unknown = (
            "total_bps",
            "budget_share",
            "encode_ms",
            "perception_ms",
            "boxes_age_s",
            "source_silent_s",
        )
        assert {waits[name] for name in unknown} == {None}, "what is unknown is not 0"
        assert waits["link"]["round_trip_ms"] is waits["link"]["reported_s"] is None
        assert asked(address, "/healthz") == (200, "ok; it waits for a ground\n")
        assert asked(address, "/readyz") == (503, "it waits for a ground\n")
        link.ground("--detector", "motion", "--classifier", "none")
        eventually(
            lambda: (state(address).get("link") or {}).get("round_trip_ms"), within_s=60, what="it flies"
        )
        eventually(lambda: state(address)["frames"]["encoded"] > 10, within_s=60, what="frames")
        now, found = state(address), series(address)
        assert (now["state"], now["link"]["ground"], now["edge"]) == ("running", True, "uav-1")
        assert 0 < now["budget_share"] <= 1
        assert now["total_bps"] >= now["base_bps"] > 0
        assert now["operating"]["base_size"] == [320, 192]
        assert now["operating"]["budget_bps"] == found["hvt_budget_bits_per_second"] == 800_000
        assert now["backlog"]["limit_bytes"] == found["hvt_edge_store_limit_bytes"] == 20_000_000
        assert now["backlog"]["disk_free_bytes"] > 0
        assert found["hvt_edge_frames_encoded_total"] > 10
        assert found["hvt_edge_sent_bits_per_second"] > 0
        assert "hvt_edge_temperature_celsius" not in found or found["hvt_edge_temperature_celsius"] > 0
        assert asked(address, "/healthz") == asked(address, "/readyz") == (200, "ok\n")
        said = status("--at", address)
        assert said.returncode == 0, said.stderr
        assert "uav-1" in said.stdout
        assert "a ground listens" in said.stdout
        assert json.loads(status("--at", address, "--json").stdout)["session"] == now["session"]
        nobody = status("--at", f"127.0.0.1:{free_ports(1)[0]}")
        assert (nobody.returncode, "no edge answers at" in nobody.stderr) == (1, True)
        busy = link.edge("--source", str(long_scene), "--metrics", address, name="busy")
        busy.until(f"--metrics {address} cannot be listened on")
        busy.kill()
        edge.stop()
        assert edge.summary()["session"] == now["session"]


@pytest.mark.nightly
def test_a_camera_that_went_away_is_no_dead_process_and_is_said(tmp_path, address):
    """A probe would restart an edge that only waits for its camera, or call one healthy that shows nothing."""
    port = free_ports(1)[0]
    with Link(tmp_path) as link:
        with RtspCamera(port) as camera:
            link.edge("--source", camera.url, "--store", "0", "--metrics", address, *SMALL)
            eventually(lambda: asked(address, "/readyz")[0] == 200, within_s=60, what="pictures come")
        eventually(lambda: "no picture for" in asked(address, "/readyz")[1], within_s=60, what="it is said")
        code, text = asked(address, "/healthz")
        assert code == 200
        assert text.startswith("ok; no picture for")
        assert "source: " in text
        assert asked(address, "/readyz")[0] == 503
        with RtspCamera(port):
            eventually(lambda: asked(address, "/readyz")[0] == 200, within_s=60, what="pictures come again")


class Hanging(Source):
    """Gives some frames of another, and then never one again."""

    live = False

    def __init__(self, inner: Source, end: threading.Event) -> None:
        self._inner, self._end = inner, end
        self.view, self.fps, self.frame_count = inner.view, inner.fps, inner.frame_count

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """See there."""
        for frame in self._inner.frames(start_ns=start_ns):
            if frame.index == 10:
                self._end.wait()
                return
            yield frame

    def close(self) -> None:
        """See there."""
        self._inner.close()


class HangingWorld(World):
    """With such a source."""

    def __init__(self, end: threading.Event) -> None:
        super().__init__()
        self._end = end

    def open_source(self, config: EdgeConfig) -> Source:
        """See there."""
        return Hanging(super().open_source(config), self._end)


def test_a_loop_that_hangs_tells_nobody_that_it_lives(tmp_path, address, free_port, monkeypatch, long_scene):
    """Nobody would ever start it again, and the picture stand still until somebody lands the drone."""
    name = str(tmp_path / "notify")
    config = check(
        EdgeConfig(
            source=str(long_scene),
            fps=5.0,
            size=(320, 192),
            method="M0",
            detector="motion",
            listen=(f"tcp/127.0.0.1:{free_port}",),
            wait=0.0,
            quiet=True,
            metrics=address,
        )
    )
    end = threading.Event()
    edge = Edge(config, stop=threading.Event(), world=HangingWorld(end))
    thread = threading.Thread(target=edge.run, daemon=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(name)
        systemd.settimeout(60)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        thread.start()
        assert systemd.recv(64) == b"READY=1"
        assert systemd.recv(64) == b"WATCHDOG=1"
        eventually(
            lambda: asked(address, "/healthz") == (503, "it stands still\n"), within_s=60, what="it is said"
        )
        systemd.settimeout(0.1)
        with contextlib.suppress(TimeoutError):  # what it said before
            while True:
                assert systemd.recv(64) == b"WATCHDOG=1"
        systemd.settimeout(3)
        with pytest.raises(TimeoutError):
            systemd.recv(64)
        end.set()
        thread.join(60)
    assert not thread.is_alive()


class SlowDetector(Detector):
    """Sees one object, and takes its time."""

    class_names = ("car",)

    def detect(self, image_bgr: Image) -> Detections:
        """See there."""
        time.sleep(1.5)
        return Detections(
            np.array([[50, 50, 90, 80]], np.float32), np.array([0.9], np.float32), np.zeros(1, np.int32)
        )


class SlowWorld(World):
    """With such a detector."""

    def open_detector(self, config: EdgeConfig) -> Detector:
        """See there."""
        return SlowDetector()


def test_a_machine_too_slow_to_detect_says_how_old_its_boxes_are(address, free_port, capsys, long_scene):
    """Boxes of seconds ago would be taken for those of now, or none for a scene without objects."""
    config = check(
        EdgeConfig(
            source=str(long_scene),
            fps=5.0,
            size=(320, 192),
            method="M2",
            listen=(f"tcp/127.0.0.1:{free_port}",),
            wait=0.0,
            metrics=address,
        )
    )
    stop = threading.Event()
    thread = threading.Thread(target=Edge(config, stop=stop, world=SlowWorld()).run, daemon=True)
    thread.start()
    try:
        eventually(lambda: state(address).get("detection_slow"), within_s=60, what="it is said")
        assert state(address)["boxes_age_s"] > 1
        assert state(address)["tracks"] >= 1
        assert series(address)["hvt_edge_boxes_age_seconds"] > 1
        eventually(
            lambda: "s old" in " ".join(status("--at", address).stdout.replace("│", " ").split()),
            within_s=60,
            what="`hvt-edge status` says it",
        )
        said: list[str] = []

        def told() -> bool:
            said.append(capsys.readouterr().err)
            return " s old: detection is too slow" in "".join(said)

        eventually(told, within_s=60, what="the status line says it, too")
    finally:
        stop.set()
        thread.join(60)
