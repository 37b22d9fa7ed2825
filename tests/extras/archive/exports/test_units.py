"""Each export writes frame, box and confidence as the table of docs/export.md shows them."""

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from mcap.reader import make_reader

from hvt_archive.exports import pictures
from hvt_archive.exports.command import write_csv, write_mot, write_parquet
from hvt_archive.exports.maps import write_geojson, write_kml
from hvt_gateways.mcap.file import McapFile
from hvt_gateways.transport_stream.uas import vmti_local_set
from hvt_ground.events import Places
from rigs.examples import overlay

OVERLAY = overlay(
    41,
    [[10, 20.5, 30, 60.5]],
    capture_ns=1_700_000_000_000_000_000,
    track_ids=np.array([7]),
    confidences=np.array([0.8764], np.float32),
    places=Places(np.array([[52.0, 13.0]]), np.array([[3.0, 2.0, 0.0]])),
)
GUESS = replace(OVERLAY, vague=np.ones(1, np.bool_))
RECORDED: Any = SimpleNamespace(
    edge="uav-1",
    session="00ff",
    overlays=lambda: [OVERLAY],
    poses=[
        SimpleNamespace(
            capture_ns=OVERLAY.capture_ns,
            pose=SimpleNamespace(longitude_deg=13.0, latitude_deg=52.0, height_m=50.0),
        )
    ],
    video=[SimpleNamespace(frame_index=41, capture_ns=OVERLAY.capture_ns)],
)


def _documented() -> dict[str, tuple[str, ...]]:
    text = (Path(__file__).parents[4] / "docs/export.md").read_text(encoding="utf-8")
    table = text[text.index("| in | frame |") :].split("\n\n")[0].splitlines()[2:]
    rows = [[re.findall("`(.*?)`", cell) for cell in line.split("|")[1:-1]] for line in table]
    return {name: tuple(" ".join(cell) for cell in row[1:]) for row in rows for name in row[0]}


def _csv(path: Path) -> tuple[str, ...]:
    write_csv(RECORDED, path)
    row = path.read_text().splitlines()[1].split(",")
    return row[0], " ".join(row[3:7]), row[7]


def _parquet(path: Path) -> tuple[str, ...]:
    write_parquet(RECORDED, path)
    (row,) = pq.read_table(path).to_pylist()
    return str(row["frame_index"]), " ".join(str(row[one]) for one in "xywh"), f"{row['confidence']:g}"


def _mot(path: Path) -> tuple[str, ...]:
    write_mot(RECORDED, path)
    row = path.read_text().split(",")
    return row[0], " ".join(row[2:6]), row[6]


def _coco(path: Path) -> tuple[str, ...]:
    path.mkdir()
    pictures.write_coco(RECORDED, path)
    content = json.loads((path / "annotations.json").read_text())
    (box,) = content["annotations"]
    assert content["images"][0]["file_name"] == "images/000041.jpg"
    return str(box["image_id"]), " ".join(map(str, box["bbox"])), str(box["score"])


def _geojson(path: Path) -> tuple[str, ...]:
    write_geojson(RECORDED, path)
    return "", "", str(json.loads(path.read_text())["features"][1]["properties"]["confidence"])


def _kml(path: Path) -> tuple[str, ...]:
    write_kml(RECORDED, path)
    value = ET.parse(path).find(".//{*}Data[@name='confidence']/{*}value")
    return "", "", value.text


def _mcap(path: Path) -> tuple[str, ...]:
    file = McapFile(path, edge="uav-1")
    file.log(OVERLAY)
    file.close()
    with path.open("rb") as opened:
        ((_, _, message),) = make_reader(opened).iter_messages()
    (box,) = ImageAnnotations.FromString(message.data).points
    corners = [box.points[0].x, box.points[0].y, box.points[2].x, box.points[2].y]
    facts = {one.key: one.value for one in box.metadata}
    return str(message.sequence), " ".join(map(str, corners)), facts["confidence"]


def _ts(_path: Path) -> tuple[str, ...]:
    whole = _items(vmti_local_set(OVERLAY, size=(640, 360), centre=None, time=bytes(8)))
    target = whole[101]
    of_target = _items(target[2:])  # behind its length and its id
    corners = [int.from_bytes(of_target[one], "big") for one in (2, 3)]
    return str(int.from_bytes(whole[7], "big")), " ".join(map(str, corners)), str(of_target[5][0])


def _items(data: bytes) -> dict[int, bytes]:
    found = {}
    while data:
        found[data[0]] = data[2 : 2 + data[1]]
        data = data[2 + data[1] :]
    return found


@pytest.mark.parametrize("kind", _documented())
def test_an_export_has_the_units_of_the_table(kind, tmp_path, monkeypatch):
    """Two files of one flight would number its frames apart, or call 88 what the other calls .876."""
    picture = np.zeros((72, 128, 3), np.uint8)
    monkeypatch.setattr(pictures, "pictures", lambda one: [(one.video[0], picture, OVERLAY)])
    assert globals()[f"_{kind}"](tmp_path / f"flight.{kind}") == _documented()[kind]


def test_a_guess_is_no_label(tmp_path, monkeypatch):
    """A vehicle whose kind the ground guessed would teach a detector that it is a car."""
    monkeypatch.setattr(
        pictures, "pictures", lambda one: [(one.video[0], np.zeros((72, 128, 3), np.uint8), GUESS)]
    )
    pictures.write_coco(RECORDED, tmp_path)
    (kind,) = json.loads((tmp_path / "annotations.json").read_text())["categories"]
    assert (kind["name"], GUESS.classes) == ("vehicle", OVERLAY.classes)
