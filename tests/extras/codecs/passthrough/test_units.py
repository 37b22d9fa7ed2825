"""A camera's packets as access units: real containers, and whatever a broken file or a stranger may send."""

from contextlib import suppress

import av
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_codecs.passthrough.stream import CameraUnits
from hvt_common.video.hevc import LONG_START, PARAMETER_SETS, BaseDecoder, nal_kind, nal_units, parameter_sets
from media.hevc_camera import SIZE, packets_of, pictures_of, write_clip


def header_of(path) -> bytes:
    """What the container says before the first packet."""
    with av.open(str(path)) as container:
        return container.streams.video[0].codec_context.extradata or b""


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.hevc", "a.ts"])
def test_a_ground_can_begin_at_each_keyframe(tmp_path, name):
    """Who joins in the middle of a flight would never see a picture: MP4 has its parameter sets once."""
    clip = write_clip(tmp_path / name, more="aud=1" if name.endswith("ts") else "")
    units = CameraUnits(header_of(clip))
    found = [units.unit(packet) for packet in packets_of(clip)]
    assert [index for index, one in enumerate(found) if one.keyframe] == [0, 10, 20, 30, 40]
    assert [[nal for nal in nal_units(one.data) if nal_kind(nal) < 32] for one in found] == pictures_of(clip)
    for first in (0, 10, 40):
        decoder = BaseDecoder(size=SIZE)
        assert all(decoder.decode(one.data) is not None for one in found[first:])


def test_what_needs_nothing_stays_as_it_is(tmp_path):
    """The camera's units would not be the camera's any more, and a check of them by their bytes fail."""
    packets = packets_of(write_clip(tmp_path / "a.hevc"))
    units = CameraUnits(b"")
    assert [units.unit(packet).data for packet in packets] == packets


def test_filler_is_left_out(tmp_path):
    """A quarter of a thin link would carry nothing where a camera at a constant rate looks at a still scene."""
    packets = packets_of(write_clip(tmp_path / "a.hevc"))
    filler = LONG_START + bytes([38 << 1, 1]) + b"\xff" * 500 + b"\x80"
    units = CameraUnits(b"")
    found = [units.unit(packet + filler) for packet in packets]
    assert [nal_units(one.data) for one in found] == [nal_units(packet) for packet in packets]
    with pytest.raises(ValueError, match="holds 0 pictures"):
        units.unit(filler)


def test_sets_that_came_once_are_put_before_later_keyframes(tmp_path):
    """Some cameras send them with the first keyframe alone."""
    packets = packets_of(write_clip(tmp_path / "a.hevc"))
    units, bare = CameraUnits(b""), []
    for packet in packets:
        kept = [one for one in nal_units(packet) if nal_kind(one) not in PARAMETER_SETS]
        bare.append(b"".join(LONG_START + one for one in kept))
    first = units.unit(packets[0])
    later = units.unit(LONG_START + bytes([35 << 1, 1, 0x50]) + bare[10])
    assert parameter_sets(later.data) == parameter_sets(first.data)
    assert nal_kind(nal_units(later.data)[0]) == 35, "a delimiter stays the first"
    with pytest.raises(ValueError, match="no VPS, SPS and PPS, and none came before it"):
        CameraUnits(b"").unit(bare[10])


def test_the_newest_sets_count(tmp_path):
    """After a camera has changed its settings, every keyframe would be put before a decoder with the old ones."""
    old = packets_of(write_clip(tmp_path / "a.hevc"))
    new = packets_of(write_clip(tmp_path / "b.hevc", more="ctu=16"))
    assert parameter_sets(old[0]) != parameter_sets(new[0])
    units = CameraUnits(b"")
    units.unit(old[0])
    units.unit(new[0])
    bare = b"".join(LONG_START + one for one in nal_units(new[10]) if nal_kind(one) not in PARAMETER_SETS)
    assert parameter_sets(units.unit(bare).data) == parameter_sets(new[0])


@pytest.mark.parametrize("number", [0, 2])
def test_a_packet_of_no_or_several_pictures_is_no_unit(tmp_path, number):
    """A frame index would be of two pictures, and everything after it a frame late."""
    packets = packets_of(write_clip(tmp_path / "a.hevc"))
    data = b"".join(packets[1 : 1 + number]) or parameter_sets(packets[0])
    with pytest.raises(ValueError, match=f"a packet holds {number} pictures, and not one"):
        CameraUnits(b"").unit(data)


@pytest.mark.parametrize(
    "damage", [lambda one: one[:-5], lambda one: one + b"\0\0\0\0", lambda one: one + b"\0\0"]
)
def test_a_packet_that_breaks_off_is_no_unit(tmp_path, damage):
    """Half a picture would be sent as a whole one."""
    clip = write_clip(tmp_path / "a.mp4")
    with pytest.raises(ValueError, match="the lengths in a packet do not add up"):
        CameraUnits(header_of(clip)).unit(damage(packets_of(clip)[0]))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("clip") / "a.mp4")


@given(
    header=st.binary(max_size=80),
    packet=st.binary(max_size=200),
    at=st.integers(0, 10**6),
    by=st.integers(0, 255),
)
def test_damage_is_a_value_error_and_nothing_else(clip, header, packet, at, by):
    """A damaged file, or a stranger's stream, would end the flight in a traceback."""
    real_header, real = bytearray(header_of(clip)), bytearray(packets_of(clip)[0])
    real_header[at % len(real_header)] = real[at % len(real)] = by
    damaged = (bytes(real_header), bytes(real))
    for one, other in ((b"\1" + header, packet), damaged, (b"", packet), (header, packet)):
        with suppress(ValueError):
            CameraUnits(one).unit(other)
