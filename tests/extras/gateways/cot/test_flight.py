"""A flight of the drawn scene, edge to ground, as somebody on the network sees it."""

from __future__ import annotations

import csv
import datetime as dt
import socket
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from hvt_common.geodesy import metres_per_degree
from hvt_common.values import View, iou
from hvt_scene import Scene
from programs.processes import Link, free_ports

pytestmark = [pytest.mark.integration, pytest.mark.timeout(240)]

FPS, FRAMES, SEED = 15, 90, 3
VIEW = View.fitted((1920, 1080), (1280, 720), fit="letterbox")


@contextmanager
def receiving(port: int) -> Iterator[list[ET.Element]]:
    """Events as they come by datagram; the list is whole at the end."""
    events: list[ET.Element] = []
    stop = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**20)
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(0.2)

        def receive() -> None:
            while True:
                try:
                    events.append(ET.fromstring(receiver.recv(65536)))
                except TimeoutError:
                    if stop.is_set():
                        return

        thread = threading.Thread(target=receive)
        thread.start()
        try:
            yield events
        finally:
            stop.set()
            thread.join()


def fly(link: Link, *ground: str, edge: tuple[str, ...] = ()) -> tuple[dict[str, Any], str]:
    """Six seconds of the scene, or what ``edge`` says; the ground's summary, and what it said."""
    running = link.ground("--once", "--tracks", "tracks.csv", "--record", "flight.rrd", *ground)
    flying = link.edge(
        *("--source", "demo", "--seed", str(SEED), "--max-frames", str(FRAMES), "--edge-id", "uav-1"),
        *("--budget", "800kbps", "--preset", "ultrafast", "--wait", "60s", *edge),
    )
    flying.finish()
    return running.finish(within_s=60), running.said


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> tuple[Path, list[ET.Element], dict[str, Any]]:
    """In lockstep, with the scene's own pose."""
    folder = tmp_path_factory.mktemp("cot")
    (port,) = free_ports(1)
    (folder / "types.toml").write_text('[classes]\nbus = "a-n-G-E-V-C"\n', encoding="utf-8")
    (folder / "stills").mkdir()
    with receiving(port) as events, Link(folder) as link:
        summary, _ = fly(
            link,
            *("--cot", f"udp://127.0.0.1:{port}", "--cot-types", "types.toml", "--stills", "stills"),
            edge=("--pose", "demo", "--pace", "lockstep"),
        )
    return folder, events, summary


def test_atoms_stand_within_their_error_of_the_objects(flight):
    """People on foot would be sent to where nothing is."""
    folder, events, _ = flight
    scene = Scene(SEED)
    with (folder / "tracks.csv").open(encoding="utf-8") as file:
        rows = {
            (row["id"], row["latitude"], row["longitude"]): row
            for row in csv.DictReader(file)
            if row["latitude"]
        }
    off_m, inside = [], []
    for event in events:
        point = event.find("point").attrib
        *_, track = event.attrib["uid"].split("-")
        row = rows.get((track, point["lat"], point["lon"]))
        if row is None or int(row["frame"]) < 2 * FPS:
            continue
        t_s = (int(row["frame"]) - 1) / FPS
        truth, middles = scene.truth(t_s), scene.places(t_s)
        x, y, wide, high = (float(row[name]) for name in "xywh")
        overlap = iou(
            np.array([[x, y, x + wide, y + high]], np.float32), VIEW.to_base(truth.boxes_source_px)
        )[0]
        if overlap.max() < 0.6:
            continue
        real = np.array(scene.geographic(*middles[int(truth.ids[overlap.argmax()])]))
        said = np.array([float(point["lat"]), float(point["lon"])])
        off_m.append(float(np.linalg.norm((said - real) * metres_per_degree(52.0))))
        inside.append(off_m[-1] <= float(point["ce"]))
    assert len(off_m) > 50
    assert np.median(off_m) < 2.0
    assert np.mean(inside) >= 0.95


def test_the_camera_is_where_the_scene_has_it(flight):
    """Its wedge would lie beside the objects that it sees."""
    _, events, _ = flight
    scene = Scene(SEED)
    platform = [one for one in events if one.attrib["uid"] == "hvt-uav-1"]
    assert platform
    way = [scene.pose(t_s) for t_s in np.linspace(0, FRAMES / FPS, 200)]
    for event in platform:
        place = np.array([float(event.find("point").attrib[name]) for name in ("lat", "lon")])
        near = min(
            float(np.linalg.norm((place - (one.latitude_deg, one.longitude_deg)) * metres_per_degree(52.0)))
            for one in way
        )
        assert near < 1.0
        sensor = event.find("detail/sensor").attrib
        assert float(sensor["fov"]) == pytest.approx(way[0].hfov_deg, abs=0.5)
        assert float(sensor["elevation"]) == pytest.approx(-90, abs=0.5)


def test_events_are_whole_and_no_more_often_than_promised(flight):
    """A receiver would drop them, or a radio net be full of them."""
    folder, events, summary = flight
    assert summary["failed"] == []
    assert not summary["missing_events"]
    times = defaultdict(list)
    for event in events:
        at, start, stale = (
            dt.datetime.fromisoformat(event.attrib[one]) for one in ("time", "start", "stale")
        )
        assert start <= at < stale
        times[event.attrib["uid"]].append(at)
    pauses = [
        (later - at).total_seconds()
        for each in times.values()
        for at, later in zip(sorted(each), sorted(each)[1:], strict=False)
    ]
    assert min(pauses) > 0.85
    with (folder / "tracks.csv").open(encoding="utf-8") as file:
        known = {row["id"] for row in csv.DictReader(file) if row["latitude"]}
    assert {uid.split("-")[-1] for uid in times if uid != "hvt-uav-1"} <= known


def test_types_are_those_of_the_table_and_of_the_user(flight):
    """Who has changed the table would see no change."""
    _, events, _ = flight
    types = defaultdict(set)
    for event in events:
        types[event.find("detail/contact").attrib["callsign"].split()[0]].add(event.attrib["type"])
    assert types["car"] == {"a-u-G-E-V-C"}
    assert types["bus"] == {"a-n-G-E-V-C"}
    assert types["uav"] == set()
    assert types["uav-1"] == {"a-f-A-M-H-Q"}


def test_stills_are_where_the_remarks_say(flight):
    """The link to the picture would lead nowhere."""
    _, events, _ = flight
    named = {
        Path(text.partition("; still ")[2])
        for event in events
        if "; still " in (text := event.find("detail/remarks").text or "")
    }
    assert named
    assert all(one.is_absolute() and one.is_file() for one in named)


@pytest.mark.nightly
def test_without_a_pose_nothing_is_sent_and_it_is_said_once(tmp_path):
    """A map without anything on it says nothing about why."""
    (port,) = free_ports(1)
    with receiving(port) as events, Link(tmp_path) as link:
        _, said = fly(
            link, "--cot", f"udp://127.0.0.1:{port}", edge=("--max-frames", "210", "--size", "640x360")
        )
    assert events == []
    assert said.count("its tracks are not reported, because it says no pose") == 1


@pytest.mark.nightly
def test_a_server_that_is_not_there_changes_nothing_else(tmp_path):
    """The flight would wait for a map that nobody looks at."""
    (port,) = free_ports(1)
    with Link(tmp_path) as link:
        summary, said = fly(
            link, "--cot", f"tcp://127.0.0.1:{port}", edge=("--pose", "demo", "--pace", "lockstep")
        )
    assert summary["frames_decoded"] == FRAMES
    (part,) = summary["failed"]
    assert part["part"] == f"CoT tcp://127.0.0.1:{port}"
    assert said.count("Connection refused; all else goes on, and it is tried again") == 1
