"""``hvt-edge doctor`` and ``hvt-ground doctor``: before the flight, not in it."""

import datetime as dt
import json
import socket
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import hvt_edge.cli
import hvt_ground.cli
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_ground.session.subscribe import GroundLink
from media.onnx_models import colour_detector, failing_in_the_light
from media.pictures import write_scene
from programs.fleet_keys import Fleet
from programs.processes import free_ports
from programs.rtsp_camera import RtspCamera

Program = Callable[[list[str]], int]
EDGE, GROUND = hvt_edge.cli.main, hvt_ground.cli.main
CHEAP = ("--size", "320x192", "--detector", "motion", "--preset", "ultrafast")


def small_scene(folder: Path) -> str:
    """Pictures that are drawn in a moment."""
    (folder / "scene").mkdir()
    write_scene(folder / "scene", frames=3)
    return str(folder / "scene")


def examined(capsys, program: Program, *words: str) -> tuple[int, dict[str, dict[str, str]]]:
    code = program(["doctor", "--json", *words])
    return code, {row["check"]: row for row in json.loads(capsys.readouterr().out)}


def with_keys(folder: Path) -> tuple[Fleet, tuple[str, ...]]:
    """A fleet of one edge, and the settings with which an edge takes its keys."""
    fleet = Fleet(folder)
    fleet.keys("add-ground", "base")
    fleet.keys("add-edge", "uav-1")
    return fleet, ("--zenoh-config", str(fleet.file("uav-1")), "--connect", "tls/127.0.0.1:7447")


def test_all_is_well_where_a_ground_listens(capsys, scene):
    """The engineer would look for a fault that is not there."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with open_session(LinkSettings("ground", listen=(endpoint,))) as ground, GroundLink(ground, edges="*"):
        code, found = examined(capsys, EDGE, "--source", str(scene), *CHEAP, "--connect", endpoint)
    assert code == 0
    assert found["link"]["found"] == "a ground listens"
    assert {one["state"] for name, one in found.items() if name not in ("clock", "processor")} == {"ok"}
    assert "960x540, sent as 320x192" in found["source"]["found"]
    assert "cores" in found["processor"]["found"]


def test_the_forecast_has_perception_within_what_video_leaves(capsys, monkeypatch, scene):
    """On a board the doctor said three times what the flight then took, and that frames would be left out."""
    monkeypatch.setattr("hvt_fleet.edge_doctor.processors", lambda: 2.0)
    monkeypatch.setattr("hvt_fleet.edge_doctor.CpuMeter.measure", lambda *_, **__: None)
    monkeypatch.setattr("hvt_fleet.edge_doctor.detect_every", lambda *_, **__: 1e-6)
    now = SimpleNamespace(monotonic=count(0, 0.01).__next__, process_time=count(0, 0.01).__next__)
    monkeypatch.setattr("hvt_fleet.edge_doctor.time", now)
    _, findings = examined(capsys, EDGE, "--source", str(scene), *CHEAP, "--connect", "tcp/127.0.0.1:9")
    found = findings["processor"]
    assert float(found["found"].split()[1]) <= 2
    assert "objects are looked for less often" in found["found"]
    assert found["state"] == "ok"


def test_each_fault_is_told_with_what_to_do(tmp_path, capsys):
    """One fault after the other would take an afternoon in a field."""
    (tmp_path / "file").write_bytes(b"")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        code, found = examined(
            capsys,
            EDGE,
            *("--source", str(tmp_path / "gone.mp4"), *CHEAP, "--detector", str(tmp_path / "gone.onnx")),
            *("--metrics", f"127.0.0.1:{taken.getsockname()[1]}"),
            *("--record-base", str(tmp_path / "no" / "base.mp4")),
            *("--connect", f"tcp/127.0.0.1:{free_ports(1)[0]}"),
        )
    assert code == 2
    for name in ("source", "files", "ports"):
        assert found[name]["state"] == "wrong", name
        assert found[name]["todo"], name
    assert found["detector"]["state"] == found["processor"]["state"] == "unknown"
    assert found["link"]["state"] == "warning", "the ground may come later"
    assert "nobody listens" in found["link"]["found"] or "refused" in found["link"]["found"], found["link"]


def test_a_network_beside_another_that_does_not_run_is_told(tmp_path, capsys):
    """It would be found out in flight: the other goes on."""
    (tmp_path / "white").mkdir()
    cv2.imwrite(str(tmp_path / "white" / "0.png"), np.full((180, 320, 3), 255, np.uint8))
    first, second = failing_in_the_light(tmp_path / "a.onnx"), colour_detector(tmp_path / "b.onnx", "yolox")
    words = (*CHEAP, "--detector", f"{first}+{second}", "--connect", "tcp/127.0.0.1:9")
    _, found = examined(capsys, EDGE, "--source", str(tmp_path / "white"), *words)
    assert found["detector"]["state"] == "wrong"
    assert found["detector"]["found"].startswith("detector 1 does not run (")
    assert found["detector"]["todo"] == "choose another with --detector"


def test_the_cameras_password_is_not_printed(free_port, capsys):
    """Whoever asks for help with the findings would give the camera away."""
    with RtspCamera(free_port) as camera:
        code = EDGE(["doctor", "--source", camera.url.replace("://", "://admin:SECRET@"), *CHEAP])
    said = capsys.readouterr()
    assert code in (0, 2)
    assert f"…@127.0.0.1:{free_port}/camera: 320x240" in said.out
    assert "SECRET" not in said.out + said.err


def test_a_certificate_that_ends_is_found_out(tmp_path, capsys):
    """The drone would stand on the ground on some morning."""
    fleet, words = with_keys(tmp_path / "own")
    now, scene = dt.datetime.now(dt.UTC), small_scene(tmp_path)
    for made, state, said in ((now - dt.timedelta(days=4000), "wrong", "expired on"), (now, "warning", "")):
        fleet.reissue("uav-1", now=made)
        capsys.readouterr()
        code, found = examined(capsys, EDGE, "--source", scene, *CHEAP, *words, "--edge-id", "uav-1")
        assert (code, found["link"]["state"]) == (2 if state == "wrong" else 0, state)
        assert said in found["link"]["found"]


def test_settings_that_contradict_are_a_sentence(capsys):
    """As in a flight."""
    assert EDGE(["doctor", "--source", "demo", "--budget", "none"]) == 2
    assert "--budget" in capsys.readouterr().err


def test_it_explains_itself(capsys):
    """Nobody would find its settings."""
    with pytest.raises(SystemExit) as ended:
        EDGE(["doctor", "--help"])
    assert ended.value.code == 0
    assert "hvt-edge doctor" in capsys.readouterr().out


def test_it_names_the_edges_that_are_there(tmp_path, capsys):
    """A ground that hears nobody would be searched for a fault of its own."""
    port, page = free_ports(2)
    words = ("--connect", f"tcp/127.0.0.1:{port}", "--record", str(tmp_path / "flights"))
    words += ("--classifier", "none", "--detector", "motion", "--web", f"127.0.0.1:{page}")
    settings = LinkSettings("edge", listen=(f"tcp/127.0.0.1:{port}",))
    with open_session(settings) as edge, edge.liveliness().declare_token("hvt/uav-7/alive"):
        code, found = examined(capsys, GROUND, *words)
    assert found["link"] == {"check": "link", "state": "ok", "found": "edges: uav-7", "todo": ""}
    assert "GB are free" in found["recordings"]["found"]
    assert not (tmp_path / "flights").exists(), "it changes nothing"
    assert (code, found["page"]["state"]) == (0, "ok")


def test_each_fault_of_a_ground_is_told_with_what_to_do(tmp_path, capsys):
    """One after the other, each after a start of its own."""
    (tmp_path / "file").write_bytes(b"")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        code, found = examined(
            capsys,
            GROUND,
            *("--detector", str(tmp_path / "gone.onnx"), "--record", str(tmp_path / "file" / "flights")),
            *("--web", f"127.0.0.1:{taken.getsockname()[1]}"),
            *("--listen", f"tcp/127.0.0.1:{free_ports(1)[0]}"),
        )
    assert code == 2
    for name in ("models", "recordings", "page"):
        assert found[name]["state"] == "wrong", found[name]
        assert found[name]["todo"], found[name]
    assert found["link"]["state"] == "warning", "edges may come later"


def test_what_extras_send_and_write_is_checked(tmp_path, capsys, monkeypatch):
    """A certificate or a folder that is missing would be found at the airfield."""
    monkeypatch.delenv("PYTAK_TLS_CLIENT_CERT", raising=False)
    link = ("--detector", "motion", "--classifier", "none", "--record", str(tmp_path))
    link += ("--connect", f"tcp/127.0.0.1:{free_ports(1)[0]}")
    (tmp_path / "notes.txt").touch()
    told = ("--cot", "udp://239.2.3.1:6969", "--stills", str(tmp_path / "notes.txt"))
    _, found = examined(capsys, GROUND, *link, *told)
    assert (found["reports"]["state"], found["recordings"]["state"]) == ("ok", "wrong")
    assert "notes.txt is no folder" in found["recordings"]["found"]
    log = tmp_path / "gone" / "flight.hvtlog"
    code, found = examined(capsys, GROUND, *link, "--cot", "tls://127.0.0.1:8089", "--log", str(log))
    assert found["recordings"]["found"] == f"--log {log} is in a folder that does not exist"
    assert (code, found["reports"]["state"]) == (2, "wrong")
    assert "PYTAK_TLS_CLIENT_CERT" in found["reports"]["found"] + found["reports"]["todo"]
