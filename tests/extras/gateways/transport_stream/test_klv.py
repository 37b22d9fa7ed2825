"""Numbers as MISB's standards code them: their own examples, and no value off by more than a step."""

from __future__ import annotations

import math

import klvdata.common
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_gateways.transport_stream.klv import (
    ber_length,
    ber_oid,
    imapb,
    item,
    packet,
    signed,
    unsigned,
    whole,
)


@pytest.mark.parametrize(
    ("data", "code"),
    [  # the examples of ST 0601, by item
        ("71c2", unsigned(159.974364843976, 0, 360, size=2)),  # 5
        ("fd3d", signed(-0.431531724, 20, size=2)),  # 6
        ("08b8", signed(3.405865659, 50, size=2)),  # 7
        ("5595b66d", signed(60.176822966978335, 90, size=4)),  # 13
        ("5b5360c4", signed(128.42675904204452, 180, size=4)),  # 14
        ("c221", unsigned(14190.7195, -900, 19_000, size=2)),  # 15
        ("cd9c", unsigned(144.5713, 0, 180, size=2)),  # 16
        ("724a0a20", unsigned(160.71921147439643, 0, 360, size=4)),  # 18
        ("03830926", unsigned(68590.98329874477, 0, 5_000_000, size=4)),  # 21
        ("f101a229", signed(-10.542388633146132, 90, size=4)),  # 23
        ("2a94", imapb(10_000, -900, 19_000, size=2)),  # ST 0903, VTarget item 12
        ("3a6667", imapb(10, -19.2, 19.2, size=3)),  # VTarget item 10
    ],
)
def test_the_examples_of_the_standards(data, code):
    """Every reader would see other numbers than were meant."""
    assert code.hex() == data


@given(st.floats(-90, 90))
def test_a_signed_value_comes_back_within_a_step(value):
    """A place would be off."""
    code = signed(value, 90, size=4)
    assert klvdata.common.bytes_to_float(code, (-(2**31 - 1), 2**31 - 1), (-90, 90)) == pytest.approx(
        value, abs=90 / 2**31
    )


@given(st.floats(-900, 19_000))
def test_an_unsigned_value_comes_back_within_a_step(value):
    """An altitude would be off."""
    code = unsigned(value, -900, 19_000, size=2)
    assert klvdata.common.bytes_to_float(code, (0, 65_535), (-900, 19_000)) == pytest.approx(value, abs=0.153)


@given(st.floats(-19.2, 19.2))
def test_an_imapb_value_comes_back_within_a_step(value):
    """ST 1201, the way back: a target would be a street away."""
    step = 2.0**-17
    offset = -19.2 / step - math.floor(-19.2 / step)
    back = step * (int.from_bytes(imapb(value, -19.2, 19.2, size=3)) - offset) - 19.2
    assert abs(back - value) <= step


@pytest.mark.parametrize("value", [20.001, -20.001, math.inf, math.nan])
def test_what_is_out_of_range_is_not_another_number(value):
    """An aircraft on its back would fly level."""
    assert signed(value, 20, size=2) == b"\x80\x00", "the standard's word for it"
    assert unsigned(value + 380, 0, 360, size=2) in (b"", unsigned(359.999, 0, 360, size=2))
    assert unsigned(math.nan, 0, 360, size=2) == b""
    assert imapb(value, -19.2, 19.2, size=3) == b""


@pytest.mark.parametrize(
    ("size", "code"), [(0, "00"), (127, "7f"), (128, "8180"), (256, "820100"), (65_536, "83010000")]
)
def test_lengths(size, code):
    """Everything behind a long item would be read as something else."""
    assert ber_length(size).hex() == code
    assert klvdata.common.ber_decode(ber_length(size)) == size


@pytest.mark.parametrize(("number", "code"), [(0, "00"), (127, "7f"), (128, "8100"), (16_384, "818000")])
def test_identifiers(number, code):
    """A track would have another's id."""
    assert ber_oid(number).hex() == code


def test_numbers_take_the_bytes_they_need():
    """A frame of many targets would be twice as large."""
    assert [whole(one).hex() for one in (0, 255, 256, 1 << 40)] == ["00", "ff", "0100", "010000000000"]


@given(st.binary(max_size=40))
def test_the_checksum_is_the_readers(value):
    """Readers drop a packet whose checksum is wrong, without a word."""
    data = packet(bytes(16), [item(3, value)])
    assert klvdata.common.packet_checksum(data) == data[-2:]
