"""What of a session is reported, as what, and when."""

import logging
from dataclasses import dataclass, field, replace
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from hvt_common.geodesy import moved
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import Info
from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose, View
from hvt_gateways.cot.event import CotMessage, default_types
from hvt_gateways.cot.reporter import SessionReporter, sensor_of
from hvt_ground.events import MessageTiming, Overlay, Places, PoseUpdate, Refinement
from rigs import examples
from rigs.messages import INFO

VIEW = View.fitted((1920, 1080), (1280, 720), fit="letterbox")
POSE = Pose(
    capture_ns=0,
    latitude_deg=52.0,
    longitude_deg=13.0,
    height_m=100.0,
    altitude_m=140.0,
    camera=Orientation(30.0, -30.0, 0.0),
    hfov_deg=60.0,
    position_error_m=2.0,
)
WALL_NS = 1_800_000_000 * SECOND_NS
LIVE = replace(INFO, edge="uav-1", session_id=0xABCDEF01C0FFEE07, pace="realtime")


@dataclass
class Rig:
    """A reporter at a time that the test sets; the wall clock and the edge's are elsewhere than the ground's."""

    info: Info = LIVE
    now_ns: int = 50 * SECOND_NS
    sent: list[CotMessage] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.reporter = SessionReporter(
            self.info,
            [self],
            types=default_types(),
            clock=lambda: self.now_ns,
            wall_ns=lambda: WALL_NS + self.now_ns,
            still_address=lambda still: f"http://ground:8080/stills/{still.still_sequence}",
        )

    def log(self, item: CotMessage) -> None:
        self.sent.append(item)

    def close(self, hurry=None) -> None:
        """As above."""

    def says(self, item) -> list[ET.Element]:
        before = len(self.sent)
        self.reporter.log(item)
        events = [ET.fromstring(one.data) for one in self.sent[before:]]
        assert [one.attrib["uid"] for one in events] == [one.uid for one in self.sent[before:]]
        return events


def overlay(capture_ns: int = 50 * SECOND_NS, *, ids=(1, 2), places=True, **changes) -> Overlay:
    """Tracks 100 m north of the camera and so on, each within 4 m."""
    count = len(ids)
    at = [moved(52.0, 13.0, north_m=100.0 * one, east_m=0.0) for one in ids]
    ellipses = np.tile([4.0, 2.0, 30.0], (count, 1))
    values = {
        "track_ids": np.array(ids, np.int64),
        "confidences": np.full(count, 0.87, np.float32),
        "places": Places(np.array(at, np.float64), ellipses.astype(np.float64)) if places else None,
    }
    return examples.overlay(7, np.zeros((count, 4)), capture_ns=capture_ns, **(values | changes))


def still(track_id: int | None, sequence: int = 3, **changes) -> Refinement:
    values = {"frame_index": 7, "still_sequence": sequence, "track_id": track_id, "class_after": "truck"}
    return examples.refinement(**(values | changes))


def test_a_track_is_an_atom_with_a_uid_of_its_own():
    """Two flights, or two drones, would push one another's objects around on the map."""
    first, second = Rig().says(overlay())
    assert first.attrib["uid"] == "hvt-uav-1-c0ffee07-1"
    assert first.attrib["type"] == "a-u-G-E-V-C"
    assert first.find("detail/contact").attrib["callsign"] == "car 1"
    point = first.find("point").attrib
    assert (float(point["lat"]), float(point["lon"])) == pytest.approx((52.0008988, 13.0), abs=1e-6)
    assert (point["ce"], point["hae"], point["le"]) == ("4.0", "9999999.0", "9999999.0")
    assert first.find("detail/link").attrib["uid"] == "hvt-uav-1"
    uids = {first.attrib["uid"], second.attrib["uid"]}
    for other in (LIVE, replace(LIVE, edge="uav-2"), replace(LIVE, session_id=LIVE.session_id + 1)):
        uids |= {one.attrib["uid"] for one in Rig(other).says(overlay())}
    assert len(uids) == 6, "of one session they are always the same"


def test_the_platform_is_one_in_all_sessions_and_has_its_field_of_view():
    """There would be a second drone on the map after each restart."""
    for info in (LIVE, replace(LIVE, session_id=5)):
        (event,) = Rig(info).says(PoseUpdate(0, 50 * SECOND_NS, POSE, VIEW))
        assert event.attrib["uid"] == "hvt-uav-1"
        assert event.attrib["type"] == "a-f-A-M-H-Q"
    sensor = {name: float(value) for name, value in event.find("detail/sensor").attrib.items()}
    assert (sensor["azimuth"], sensor["elevation"], sensor["fov"]) == (30, -30, 60)
    assert sensor["vfov"] == pytest.approx(36.0, abs=0.1)
    assert sensor["range"] == pytest.approx(100 / np.tan(np.radians(30 - 18)), rel=0.01)
    assert float(event.find("point").attrib["ce"]) == pytest.approx(2 * 2.448, abs=0.05)
    assert event.find("detail/remarks").text == "100 m above the ground, 140 m above mean sea level"


@pytest.mark.parametrize(
    ("pitch_deg", "height_m", "range_m"),
    [
        (-90, 100, 32.5),
        (-30, 100, 470.5),
        (-18.5, 100, 5000),
        (0, 100, 5000),
        (40, 100, 5000),
        (-30, None, None),
        (None, 100, None),
    ],
)
def test_the_wedge_ends_where_the_camera_sees_the_ground_no_longer(pitch_deg, height_m, range_m):
    """It would cover a country, or be taken for something that nobody knows; a GPS track alone looks nowhere."""
    camera = None if pitch_deg is None else Orientation(0, pitch_deg, 0)
    pose = replace(POSE, camera=camera, height_m=height_m)
    found = sensor_of(pose, VIEW)
    assert (found is None) == (camera is None)
    assert (found and found.range_m) == (None if range_m is None else pytest.approx(range_m, rel=0.01))
    assert sensor_of(replace(pose, hfov_deg=None), VIEW) is None
    (event,) = Rig().says(PoseUpdate(0, 50 * SECOND_NS, pose, VIEW))
    assert (event.find("detail/sensor") is None) == (camera is None)


def test_times_are_of_the_wall_clock_whatever_the_edge_believes():
    """A drone whose clock is an hour behind would be stale for everybody, always."""
    rig = Rig()
    late_ns = -3600 * SECOND_NS
    timing = MessageTiming(Channel.BASE, 0, 0, 0, 0, 0, 0, 0, clock_offset_ns=late_ns)
    assert rig.says(timing) == []
    times = rig.says(overlay(rig.now_ns + late_ns - SECOND_NS // 2))[0].attrib
    shown = [times[name].removeprefix("2027-01-15T08:00:") for name in ("time", "start", "stale")]
    assert shown == ["50.000Z", "49.500Z", "54.500Z"]


def test_what_is_old_is_not_reported_and_lockstep_is_now():
    """Objects of an outage, or of a file that is analyzed, would be shown where they were then."""
    rig = Rig()
    assert rig.says(overlay(rig.now_ns - 6 * SECOND_NS)) == []
    assert rig.says(overlay(rig.now_ns, stored=True)) == []
    assert rig.says(PoseUpdate(0, rig.now_ns - 60 * SECOND_NS, POSE, VIEW)) == []
    assert len(rig.says(overlay(rig.now_ns))) == 2
    media = Rig(replace(LIVE, pace="lockstep"))
    assert media.says(overlay(0))[0].attrib["start"] == "2027-01-15T08:00:50.000Z"


def test_a_time_from_the_wire_makes_no_nonsense():
    """A forged time would end the reports, or make an object that never goes stale."""
    poses = (replace(POSE, capture_ns=at_ns) for at_ns in (-(2**63), 2**63 - 1))
    updates = (PoseUpdate(0, pose.capture_ns, pose, VIEW) for pose in poses)
    for item in (*map(overlay, (-(2**63), 2**63 - 1)), *updates):
        for event in Rig().says(item):
            assert event.attrib["start"] == event.attrib["time"] == "2027-01-15T08:00:50.000Z"


def test_remarks_say_what_is_known_and_where_the_still_is():
    """The operator would see a dot, and not why it is called a truck."""
    rig = Rig()
    rig.says(still(1))
    rig.says(still(None, 4))
    rig.says(still(2, 5))  # of what was there before, whose name it had
    rig.says(still(1, 2, stored=True))
    first, second = rig.says(
        overlay(classes=("truck", "car"), refined=np.array([True, False]), sure=np.array([True, False]))
    )
    assert first.find("detail/remarks").text == (
        "truck 0.87; refined by stills, which agree; car in the video; still http://ground:8080/stills/3"
    )
    assert first.find("detail/link").attrib["url"] == "http://ground:8080/stills/3"
    assert second.find("detail/remarks").text == "car 0.87"
    assert "url" not in second.find("detail/link").attrib


def test_the_remarks_of_a_vague_kind_of_vehicle_name_no_kind():
    """The video of which they speak shows "vehicle" too."""
    kinds: dict[str, Any] = {"base_classes": ("truck", "van"), "classes": ("truck", "bus")}
    events = Rig().says(overlay(**kinds, vague=np.array([True, True])))
    assert [one.find("detail/remarks").text for one in events] == ["vehicle 0.87"] * 2


def test_only_what_has_a_place_and_is_not_doubted_is_reported():
    """Objects would lie in the sea at 0° north, 0° east, or be what stills say that they are not."""
    places = overlay(ids=(1, 2, 3)).places
    places.places_deg[0] = np.nan
    events = Rig().says(overlay(ids=(1, 2, 3), places=True, doubted=np.array([False, True, False])))
    assert [one.attrib["uid"][-1] for one in events] == ["1", "3"]
    shown = replace(overlay(ids=(1, 2, 3)), places=places)
    assert [one.attrib["uid"][-1] for one in Rig().says(shown)] == ["2", "3"]


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        (None, "it says no pose (hvt-edge --pose)"),
        (replace(POSE, camera=None), "its pose says no direction"),
        (replace(POSE, hfov_deg=None, camera=None), "its pose says no direction and no field of view"),
        (replace(POSE, height_m=None, altitude_m=None), "its pose says no height"),
        (replace(POSE, height_m=None), "its pose says only how high it is above the sea, and "),
        (replace(POSE, height_m=-0.5), "its pose says -0.5 m above the ground"),
        (POSE, "they are at the horizon, or the pose is old, or --terrain has no ground "),
    ],
)
def test_without_places_there_is_one_notice(pose, reason, caplog):
    """The operator would stare at an empty map, search for the wrong fault, or the log be full of it."""
    rig = Rig()
    for _ in range(60):
        rig.now_ns += SECOND_NS
        if pose is not None:
            rig.says(PoseUpdate(0, rig.now_ns, replace(pose, capture_ns=rig.now_ns), VIEW))
        assert rig.says(overlay(rig.now_ns, places=False)) == []
    (notice,) = caplog.records
    assert notice.levelno == logging.WARNING
    assert notice.message.startswith(f"CoT of uav-1: its tracks are not reported, because {reason}")


def test_a_flight_that_has_places_is_not_said_to_have_none(caplog):
    """The log would cry wolf at each tilt to the horizon."""
    rig = Rig()
    for second in range(60):
        rig.now_ns += SECOND_NS
        rig.says(overlay(rig.now_ns, places=not second))
    assert caplog.messages == []


def test_platform_and_tracks_that_move_say_where_to():
    """The arrow on the map is what the operator drives by."""
    rig = Rig()
    for second in range(6):
        rig.now_ns = (50 + second) * SECOND_NS
        north, east = moved(52.0, 13.0, north_m=0.0, east_m=12.0 * second)
        pose = replace(POSE, capture_ns=rig.now_ns, latitude_deg=north, longitude_deg=east)
        platform = rig.says(PoseUpdate(0, rig.now_ns, pose, VIEW))[0]
        shown = overlay(rig.now_ns, ids=(1,))
        shown.places.places_deg[0] = (north, east)
        track = rig.says(shown)[0]
    for event in (platform, track):
        motion = event.find("detail/track").attrib
        assert float(motion["course"]) == pytest.approx(90, abs=1)
        assert float(motion["speed"]) == pytest.approx(12, abs=0.2)


def test_a_platform_is_reported_once_a_second():
    """Whoever floods the poses would flood the radio net of others."""
    rig = Rig()
    count = 0
    for number in range(1000):
        rig.now_ns += SECOND_NS // 100
        count += len(rig.says(PoseUpdate(0, rig.now_ns, replace(POSE, capture_ns=rig.now_ns), VIEW)))
        assert number < 5 or count >= 1
    assert 9 <= count <= 12


def test_a_flood_of_stills_and_tracks_fills_no_memory():
    """A ground that runs for weeks would end by it; the newest ones count."""
    rig = Rig()
    for number in range(20_000):
        rig.says(still(number))
    rig.says(overlay(ids=(1, 19_999), refined=np.ones(2, bool)))
    first, last = (ET.fromstring(one.data) for one in rig.sent)
    assert "url" not in first.find("detail/link").attrib
    assert "url" in last.find("detail/link").attrib
