"""A flight of the drawn scene, edge to ground, as somebody on the network sees it."""

import datetime as dt
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from hvt_common.geodesy import metres_per_degree
from rigs.drawn_flight import FPS, FRAMES, off_m, scene

pytestmark = pytest.mark.integration


def test_atoms_stand_within_their_error_of_the_objects(drawn):
    """People on foot would be sent to where nothing is."""
    rows = {(row["id"], row["latitude"], row["longitude"]): row for row in drawn.tracks() if row["latitude"]}
    found = []
    for event in drawn.events:
        point = event.find("point").attrib
        row = rows.get((event.attrib["uid"].split("-")[-1], point["lat"], point["lon"]))
        if row is not None and int(row["frame_index"]) >= FPS - 1 and (off := off_m(row)) is not None:
            found.append((off, off <= float(point["ce"])))
    assert len(found) > 30
    assert np.median([off for off, _ in found]) < 2.0
    assert np.mean([inside for _, inside in found]) >= 0.95


def test_the_camera_is_where_the_scene_has_it(drawn):
    """Its wedge would lie beside the objects that it sees."""
    platform = [one for one in drawn.events if one.attrib["uid"] == "hvt-uav-1"]
    assert platform
    way = [scene().pose(t_s) for t_s in np.linspace(0, FRAMES / FPS, 200)]
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


def test_events_are_whole_and_no_more_often_than_promised(drawn):
    """A receiver would drop them, or a radio net be full of them."""
    assert drawn.ground["failed"] == []
    assert not drawn.ground["missing_events"]
    times = defaultdict(list)
    for event in drawn.events:
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
    known = {row["id"] for row in drawn.tracks() if row["latitude"]}
    assert {uid.split("-")[-1] for uid in times if uid != "hvt-uav-1"} <= known


def test_types_are_those_of_the_table_and_of_the_user(drawn):
    """Who has changed the table would see no change."""
    types = defaultdict(set)
    for event in drawn.events:
        types[event.find("detail/contact").attrib["callsign"].split()[0]].add(event.attrib["type"])
    assert types["car"] == {"a-u-G-E-V-C"}
    assert types["bus"] == {"a-n-G-E-V-C"}
    assert types["uav"] == set()
    assert types["uav-1"] == {"a-f-A-M-H-Q"}


def test_stills_are_where_the_remarks_say(drawn):
    """The link to the picture would lead nowhere."""
    named = {
        Path(text.partition("; still ")[2])
        for event in drawn.events
        if "; still " in (text := event.find("detail/remarks").text or "")
    }
    assert named
    assert all(one.is_absolute() and one.is_file() for one in named)
