"""The XML of an event, read by a parser that knows nothing of it."""

from dataclasses import replace
from xml.etree import ElementTree as ET

import pytest

from hvt_common.errors import UserError
from hvt_gateways.cot.event import CotEvent, Motion, Parent, Point, Sensor, default_types, read_types
from hvt_gateways.cot.extra import CotExtra, CotOptions

NOW_NS = 1_800_000_000_123_000_000
EVENT = CotEvent(
    uid="hvt-uav-1-00c0ffee-17",
    type="a-u-G-E-V-C",
    how="m-f",
    time_ns=NOW_NS,
    start_ns=NOW_NS - 400_000_000,
    stale_ns=NOW_NS + 4_600_000_000,
    point=Point(52.0000001, -13.25, ce_m=4.25),
    callsign="car 17",
)


def read(event: CotEvent) -> ET.Element:
    return ET.fromstring(event.message().data)


def test_an_event_has_what_the_schema_demands():
    """ATAK drops what lacks one of these, without a word."""
    event = read(EVENT)
    point = {"lat": "52.0000001", "lon": "-13.2500000", "hae": "9999999.0", "ce": "4.2", "le": "9999999.0"}
    assert [(one.tag, one.attrib) for one in event] == [("point", point), ("detail", {})]
    assert event.find("detail/contact").attrib == {"callsign": "car 17"}
    assert (event.tag, event.attrib) == (
        "event",
        {
            "version": "2.0",
            "uid": "hvt-uav-1-00c0ffee-17",
            "type": "a-u-G-E-V-C",
            "how": "m-f",
            "time": "2027-01-15T08:00:00.123Z",
            "start": "2027-01-15T07:59:59.723Z",
            "stale": "2027-01-15T08:00:04.723Z",
        },
    )


def test_what_is_not_known_is_left_out():
    """A course of 0 that nobody measured would be an arrow to the north."""
    assert {one.tag for one in read(EVENT).find("detail")} == {"contact", "remarks"}
    sensor = Sensor(azimuth_deg=-10, elevation_deg=-30, roll_deg=0, hfov_deg=45, vfov_deg=26, range_m=None)
    assert "range" not in read(replace(EVENT, sensor=sensor)).find("detail/sensor").attrib


def test_field_of_view_motion_and_link_are_where_atak_reads_them():
    """The platform would be a point without a wedge, and the object one without an arrow."""
    event = replace(
        EVENT,
        sensor=Sensor(-10, elevation_deg=-30, roll_deg=2, hfov_deg=45, vfov_deg=26, range_m=812),
        motion=Motion(271.04, 12.34),
        parent=Parent("hvt-uav-1", "a-f-A-M-H-Q", "uav-1"),
        url="http://ground:8080/stills/uav-1/00ff-3/still",
    )
    detail = read(event).find("detail")
    sensor = {"azimuth": "350.0", "elevation": "-30.0", "roll": "2.0", "fov": "45.0", "vfov": "26.0"}
    sensor |= {"range": "812.0", "displayMagneticReference": "0", "fovAlpha": "0.3"}
    assert detail.find("sensor").attrib == sensor
    assert detail.find("track").attrib == {"course": "271.0", "speed": "12.3"}
    (link,) = detail.findall("link")  # of two, ATAK would take the platform's uid from the one without
    assert link.attrib == {
        "relation": "p-p",
        "uid": "hvt-uav-1",
        "type": "a-f-A-M-H-Q",
        "parent_callsign": "uav-1",
        "production_time": "2027-01-15T07:59:59.723Z",
        "url": "http://ground:8080/stills/uav-1/00ff-3/still",
        "mime": "image/jpeg",
    }


@pytest.mark.parametrize(
    ("degrees", "said"), [(359.97, "0.0"), (359.94, "359.9"), (0.0, "0.0"), (-0.03, "0.0")]
)
def test_north_is_0_and_never_360(degrees, said):
    """A reader that takes 0 up to 360 would refuse the event of whoever goes north."""
    sensor = Sensor(degrees, elevation_deg=-30, roll_deg=0, hfov_deg=45, vfov_deg=26, range_m=None)
    detail = read(replace(EVENT, motion=Motion(degrees, 3.0), sensor=sensor)).find("detail")
    assert detail.find("track").attrib["course"] == said
    assert detail.find("sensor").attrib["azimuth"] == said


@pytest.mark.parametrize(
    ("said", "read_as"),
    [
        ("<b a='&\"'>]]></remarks>", "<b a='&\"'>]]></remarks>"),
        ("car\x00\x07\x1b[31m red\x7f\x9f", "car[31m red"),
        ("two\nlines\tof  it\u2028here", "two lines of it here"),
        ("\u202egpj.rac\u2069\ufeff\u200b", "gpj.rac"),
        ("\ud800 half \udfff", "half"),
        ("\ufffe\uffff", None),
        ("boat 船 🚤", "boat 船 🚤"),
    ],
)
def test_text_from_the_network_harms_no_reader(said, read_as):
    """A class name could end the event, forge a second one, or turn the words of the operator around."""
    event = replace(EVENT, callsign=said, remarks=said)
    data = event.message().data
    assert data.count(b"<event") == data.count(b"</event>") == 1
    detail = read(event).find("detail")
    assert detail.find("remarks").text == read_as
    assert detail.find("contact").attrib["callsign"] == (read_as or "")


def test_an_event_is_bounded():
    """A class name of a megabyte would be sent once a second, in datagrams that nobody can take."""
    link = Parent("hvt-uav-1", "a-f-A-M-H-Q", "uav-1")
    huge = replace(EVENT, callsign="x" * 10**6, remarks="&" * 10**6, url="http://" + "y" * 10**4, parent=link)
    assert len(huge.message().data) < 8000
    detail = read(huge).find("detail")
    assert len(detail.find("contact").attrib["callsign"]) == 64
    assert len(detail.find("remarks").text) == 400
    assert "url" not in detail.find("link").attrib, "half an address leads nowhere"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None])
def test_an_error_that_is_no_number_is_unknown(value):
    """A reader that takes it for a number would fail, or draw a circle around the world."""
    point = read(replace(EVENT, point=Point(1, 2, ce_m=value, hae_m=value))).find("point")
    assert (point.attrib["ce"], point.attrib["hae"]) == ("9999999.0", "9999999.0")


# Which class is of which type: the table that comes with it, and a user's.


def test_classes_have_types_and_nobody_is_an_enemy():
    """The map would show what no detector knows: whose it is."""
    types = default_types()
    found = {name: types.of_class(name) for name in ("car", "Van", "pedestrian", "boat", "moving", "zebra")}
    ground = dict.fromkeys(("pedestrian", "moving", "zebra"), "a-u-G")
    assert found == {"car": "a-u-G-E-V-C", "Van": "a-u-G-E-V-C", "boat": "a-u-S"} | ground
    assert types.of_edge("uav-1") == "a-f-A-M-H-Q"
    assert all(one.startswith("a-u-") for one in types.classes.values())


def test_rows_of_the_user_go_before_ours(tmp_path):
    """Who knows more than the detector could not say it."""
    file = tmp_path / "types.toml"
    file.write_text(
        '[classes]\nCar = "a-n-G-E-V-C"\n"pickup truck" = "a-h-G"\n"*" = "a-p-G"\n'
        '[platforms]\n"rover-*" = "a-f-G-E-V"\n"*" = "a-f-A"\n'
    )
    types = read_types(file)
    found = [types.of_class(name) for name in ("car", "pickup truck", "boat", "zebra")]
    assert found == ["a-n-G-E-V-C", "a-h-G", "a-u-S", "a-p-G"], "what it does not name is as it was"
    assert (types.of_edge("rover-2"), types.of_edge("uav-1")) == ("a-f-G-E-V", "a-f-A")
    assert read_types(None) == default_types()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[classes]\ncar = 3\n", "[classes] car = '3' is no Cursor on Target type"),
        (b'[classes]\ncar = "a-u-G E"\n', "[classes] car = 'a-u-G E' is no"),
        (b'[classes]\ncar = "a_u_G"\n', "[classes] car = 'a_u_G' is no"),
        (b'[classes]\ncar = ""\n', "[classes] car = '' is no"),
        (b'[classes]\ncar = "' + b"a-" * 40 + b'a"\n', "is no Cursor on Target type"),
        (b'[platforms]\n"*" = ["a"]\n', "[platforms] * = "),
        (b'car = "a-u-G"\n', "'car' is not known: give the tables [classes] and [platforms]"),
        (b'[types]\ncar = "a-u-G"\n', "'types' is not known"),
        (b"classes = 3\n", "[classes] is no table"),
        (b'[classes]\n"" = "a-u-G"\n', "a name has 1 to 128 characters"),
        (b"car: a-u-G\n", "is no TOML"),
        (b"\xff\xff", "not UTF-8 text"),
        (b"x = " + b"[" * 100_000, "is no TOML"),
        (b"#" * (2**20 + 1), "larger than 1 MB"),
        (None, "cannot be read (No such file"),
    ],
)
def test_a_wrong_table_is_refused_in_one_sentence(tmp_path, content, said):
    """Every object of the flight would be something else, and nobody would know why."""
    file = tmp_path / "types.toml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(UserError) as refusal:
        CotExtra().check_outputs(CotOptions(cot=("udp://239.2.3.1:6969",), cot_types=file))
    assert said in str(refusal.value)
    assert f"--cot-types {file}" in str(refusal.value)
    assert len(str(refusal.value)) < 400 + len(str(file))
