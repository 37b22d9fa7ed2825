"""One real flight of the drawn scene into every sink, and what of it is true: flown once, read by several tests."""

import csv
import functools
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from hvt_common.geodesy import metres_per_degree
from hvt_common.values import View, iou
from hvt_scene import Scene
from programs.processes import Link, free_ports

FPS, FRAMES, SEED = 15, 30, 3
SIZE = (640, 360)
VIEW = View.fitted((1920, 1080), SIZE, fit="letterbox")


@functools.cache
def scene() -> Scene:
    """What is flown over; to paint it takes seconds."""
    return Scene(SEED)


@dataclass(frozen=True)
class DrawnFlight:
    """What two seconds left: a folder with flight.rrd, .csv, .hvtlog and stills, both summaries.

    And with the gateways flight.ts and CoT events.
    """

    folder: Path
    events: list[ET.Element]
    edge: dict[str, Any]
    ground: dict[str, Any]

    def tracks(self) -> list[dict[str, str]]:
        with (self.folder / "flight.csv").open(encoding="utf-8") as file:
            return list(csv.DictReader(file))


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


def fly(link: Link, *ground: str, edge: tuple[str, ...] = ()) -> tuple[dict[str, Any], dict[str, Any], str]:
    """Two seconds of the scene, or what ``edge`` says; both summaries, and what the ground said."""
    running = link.ground(
        "--once", "--provider", "cpu", "--record", "flight.rrd", "--tracks", "flight.csv", *ground
    )
    flying = link.edge(
        *("--source", "demo", "--seed", str(SEED), "--max-frames", str(FRAMES), "--edge-id", "uav-1"),
        *f"--size {SIZE[0]}x{SIZE[1]} --budget 800kbps --preset ultrafast --wait 60s".split(),
        *edge,
    )
    return flying.finish(), running.finish(), running.said


def fly_into_all_sinks(folder: Path) -> DrawnFlight:
    (port,) = free_ports(1)
    (folder / "types.toml").write_text('[classes]\nbus = "a-n-G-E-V-C"\n', encoding="utf-8")
    (folder / "stills").mkdir()
    gateways = ("--cot", f"udp://127.0.0.1:{port}", "--cot-types", "types.toml", "--ts", "flight.ts")
    sinks = ("--stills", "stills", "--log", "flight.hvtlog", *(gateways if find_spec("hvt_gateways") else ()))
    with receiving(port) as events, Link(folder, name="drawn") as link:
        edge, ground, _ = fly(
            link, *sinks, edge=("--pose", "demo", "--pace", "lockstep", "--provider", "cpu")
        )
    return DrawnFlight(folder, events, edge, ground)


@functools.lru_cache(maxsize=FRAMES)
def _truth(frame_index: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Boxes in base pixels and places (latitude, longitude) of all that is there."""
    truth, middles = scene().truth(frame_index / FPS), scene().places(frame_index / FPS)
    places = [np.array(scene().geographic(*middles[one])) for one in truth.ids.tolist()]
    return VIEW.to_base(truth.boxes_source_px), places


def off_m(row: Mapping[str, str]) -> float | None:
    """How far the place in a row of the tracks table is from its object's; None where no object is in its box."""
    boxes, places = _truth(int(row["frame_index"]))
    x, y, wide, high = (float(row[name]) for name in "xywh")
    overlap = iou(np.array([[x, y, x + wide, y + high]], np.float32), boxes)[0]
    if overlap.max() < 0.6:
        return None
    said = np.array([float(row["latitude"]), float(row["longitude"])])
    return float(np.linalg.norm((said - places[int(overlap.argmax())]) * metres_per_degree(52.0)))
