"""An edge that is watched: what Prometheus, a probe and systemd learn while it flies, waits and hangs."""

import contextlib
import json
import socket
import threading
import time

import pytest

from hvt_common.inference.detect import Detector
from hvt_common.values import Detections, Image
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig, check
from hvt_edge.source.contract import Source
from hvt_edge.world import World
from programs.processes import Link, eventually, free_ports
from programs.rtsp_camera import RtspCamera
from rigs.examples import detections
from rigs.watched_flight import SMALL, STORE_BYTES, asked, series, state, status
from rigs.world import PassedOn

pytestmark = pytest.mark.integration


@pytest.fixture
def address() -> str:
    return f"127.0.0.1:{free_ports(1)[0]}"


def test_an_edge_says_how_it_is_from_its_start_to_its_flight(watched):
    """A team would learn of an edge only what reaches the ground."""
    waits = watched.waiting.state
    assert (waits["state"], waits["frames"]["account"]["came"]) == ("waiting", 0)
    unknown = ("total_bps", "budget_share", "encode_ms", "perception_ms", "boxes_age_s", "source_silent_s")
    assert {waits[name] for name in unknown} == {None}, "what is unknown is not 0"
    assert waits["link"]["round_trip_ms"] is waits["link"]["reported_s"] is None
    assert watched.waiting.healthz == (200, "ok; it waits for a ground\n")
    assert watched.waiting.readyz == (503, "it waits for a ground\n")
    now, found = watched.flying.state, series(watched.flying.metrics)
    assert (now["state"], now["link"]["ground"], now["edge"]) == ("running", True, "uav-1")
    assert 0 < now["budget_share"] <= 1
    assert now["total_bps"] >= now["base_bps"] > 0
    assert now["operating"]["base_size"] == [320, 192]
    assert now["operating"]["budget_bps"] == found["hvt_budget_bits_per_second"] == 800_000
    assert now["backlog"]["limit_bytes"] == found["hvt_edge_store_limit_bytes"] == STORE_BYTES
    assert now["backlog"]["disk_free_bytes"] > 0
    assert found["hvt_edge_frames_encoded_total"] > 10
    assert found["hvt_edge_sent_bits_per_second"] > 0
    assert "hvt_edge_temperature_celsius" not in found or found["hvt_edge_temperature_celsius"] > 0
    assert watched.flying.healthz == watched.flying.readyz == (200, "ok\n")
    code, said, _ = watched.status
    assert code == 0
    assert "uav-1" in said
    assert "a ground listens" in said
    assert json.loads(watched.status_json[1])["session"] == now["session"] == watched.edge["session"]


def test_where_no_edge_answers_is_a_sentence():
    """A traceback would say that the command is broken."""
    code, _, said = status("--at", f"127.0.0.1:{free_ports(1)[0]}")
    assert (code, "no edge answers at" in said) == (1, True)


@pytest.mark.nightly
def test_a_camera_that_went_away_is_no_dead_process_and_is_said(tmp_path, address):
    """A probe would restart an edge that only waits for its camera, or call one healthy that shows nothing."""
    port = free_ports(1)[0]
    with Link(tmp_path) as link:
        with RtspCamera(port) as camera:
            link.edge("--source", camera.url, "--store", "0", "--metrics", address, *SMALL)
            eventually(lambda: asked(address, "/readyz")[0] == 200, what="pictures come")
        eventually(lambda: "no picture for" in asked(address, "/readyz")[1], what="it is said")
        code, text = asked(address, "/healthz")
        assert code == 200
        assert text.startswith("ok; no picture for")
        assert "source: " in text
        assert asked(address, "/readyz")[0] == 503
        with RtspCamera(port):
            eventually(lambda: asked(address, "/readyz")[0] == 200, what="pictures come again")


def config_of(scene, port: int, **settings) -> EdgeConfig:
    plain = {"source": str(scene), "fps": 5.0, "size": (320, 192), "wait": 0.0}
    return check(EdgeConfig(**plain, listen=(f"tcp/127.0.0.1:{port}",), **settings))


class HangingWorld(World):
    """Whose source gives some frames, and then never one again."""

    def __init__(self, end: threading.Event) -> None:
        super().__init__()
        self._end = end

    def open_source(self, config: EdgeConfig) -> Source:
        return PassedOn(
            super().open_source(config), before=lambda frame: frame.index == 10 and self._end.wait()
        )


def test_a_loop_that_hangs_tells_nobody_that_it_lives(tmp_path, address, free_port, monkeypatch, long_scene):
    """Nobody would ever start it again, and the picture stand still until somebody lands the drone."""
    name = str(tmp_path / "notify")
    config = config_of(long_scene, free_port, metrics=address, method="M0", detector="motion", quiet=True)
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
        eventually(lambda: asked(address, "/healthz") == (503, "it stands still\n"), what="it is said")
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
        time.sleep(1.5)
        return detections([(50, 50, 90, 80)])


class SlowWorld(World):
    """With such a detector."""

    def open_detector(self, config: EdgeConfig) -> Detector:
        return SlowDetector()


def test_a_machine_too_slow_to_detect_says_how_old_its_boxes_are(address, free_port, capsys, long_scene):
    """Boxes of seconds ago would be taken for those of now, or none for a scene without objects."""
    config = config_of(long_scene, free_port, metrics=address, method="M2")
    stop = threading.Event()
    thread = threading.Thread(target=Edge(config, stop=stop, world=SlowWorld()).run, daemon=True)
    thread.start()
    try:
        eventually(lambda: state(address).get("detection_slow"), what="it is said")
        assert state(address)["boxes_age_s"] > 1
        assert state(address)["tracks"] >= 1
        assert series(asked(address, "/metrics")[1])["hvt_edge_boxes_age_seconds"] > 1
        eventually(
            lambda: "s behind" in " ".join(status("--at", address)[1].replace("│", " ").split()),
            what="`hvt-edge status` says it",
        )
        said: list[str] = []

        def told() -> bool:
            said.append(capsys.readouterr().err)
            return " s behind: detection is too slow" in "".join(said)

        eventually(told, what="the status line says it, too")
    finally:
        stop.set()
        thread.join(60)
