"""The wire format: every message there and back, and what is said of one that cannot be read.

Bounds of every field, later minor versions and damage are vectors, which tests/lab/test_conformance.py has the code
make again. Arbitrary bytes are targets of the fuzzer: tests/lab/test_fuzz.py.
"""

import re
import struct
import zlib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, cast

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import (
    MAX_STILL_RESULTS,
    READ_VERSIONS,
    AcknowledgedRange,
    AlsoShown,
    BaseHeader,
    ControlRequest,
    FailedPart,
    Feedback,
    Health,
    Info,
    InfoRequest,
    Message,
    PackedMessage,
    RoiHeader,
    StillResult,
    StillWire,
    TrackNow,
    UnknownVersionError,
    WireError,
    fitted_class_names,
    kinds,
    parse_backlog_still,
    parse_backlog_units,
)
from hvt_common.protocol.messages.envelope import WIRE_VERSION, Nested
from hvt_common.protocol.messages.fields import (
    I63,
    U32,
    Blob,
    Box,
    Flag,
    Int,
    ListOf,
    MapOf,
    OneOf,
    Real,
    Scalar,
    Scaled,
    Text,
)
from hvt_common.units import shown_text
from hvt_common.values import View
from lab.conformance.schema import described
from rigs.messages import BASE, EXAMPLES, FEEDBACK, INFO, INFO_REQUEST, REQUEST, ROI, STATUS, STEP

DOCUMENT = Path(__file__).resolve().parents[4] / "docs" / "wire-messages.md"
V4 = WIRE_VERSION - 1
MESSAGES = tuple(type(one) for one in EXAMPLES)


def value_of(kind):  # noqa: C901, PLR0911, PLR0912 - one case for each kind
    """Any value that a field of this kind may have."""
    match kind:
        case Int(low, high):
            return st.integers(low, high)
        case Scaled(low, high, per):
            return st.integers(round(low * per), round(high * per)).map(lambda raw: raw / per)
        case Real(low, high):
            return st.floats(low, high)
        case Flag():
            return st.booleans()
        case Blob(max_bytes):
            return st.binary(max_size=min(max_bytes, 300))
        case Text(max_bytes):
            printable = st.characters(exclude_categories=("C", "Z"), include_characters=" ")
            return st.text(printable, max_size=max_bytes // 4)
        case OneOf(words):
            return st.sampled_from(words)
        case Scalar(max_bytes):
            return st.integers(-I63, I63) | st.floats(-1e300, 1e300) | value_of(Text(max_bytes))
        case Box(Scaled(_, _, per)):
            place = st.tuples(st.integers(-2000, 0), st.integers(-2000, 0), st.integers(0, 2000), st.just(7))
            return place.map(lambda box: tuple(one / per for one in box))
        case Box():
            corner, side = st.integers(0, 16000), st.integers(1, 16000)
            crop = st.tuples(corner, corner, side, side)
            return crop.map(lambda box: (box[0], box[1], box[0] + box[2], box[1] + box[3]))
        case ListOf(inner, max_items, least):
            return st.lists(value_of(inner), min_size=least, max_size=min(max_items, 6)).map(tuple)
        case MapOf(inner, max_items, key_bytes):
            return st.dictionaries(value_of(Text(key_bytes)), value_of(inner), max_size=min(max_items, 6))
        case Nested(of):
            return st.builds(of, **{name: value_of(inner) for name, inner in kinds(of)})
    raise AssertionError(kind)


def message_of(message):
    values = {name: value_of(kind) for name, kind in kinds(message)}
    if message.NEGOTIATES:
        values |= {"lowest_version": st.integers(1, WIRE_VERSION)}
        values |= {"highest_version": st.integers(WIRE_VERSION, 255)}
    return st.builds(message, **values)


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
@given(data=st.data(), payload=st.binary(max_size=200))
@settings(max_examples=15)
def test_every_message_survives_the_wire(kind, data, payload):
    """A user would see boxes, classes or counts other than those the edge meant."""
    message = data.draw(message_of(kind))
    assert kind.parse(message.pack(payload), payload) == message


@pytest.mark.parametrize(
    "data",
    [
        b"\x91" * 60_000,
        *(one + b"\xff" * 4 for one in (b"\xdd", b"\xdf", b"\xc6")),
        b"\xc7\x0c\xff" + b"\xff" * 12,
    ],
)
def test_a_head_that_promises_more_than_comes_is_a_wire_error(data):
    """A message of five bytes would have gigabytes reserved, or end the thread in arrays in arrays."""
    for parse in (*(one.parse for one in MESSAGES), parse_backlog_still, parse_backlog_units):
        with pytest.raises(WireError):
            parse(data)


def test_typical_sizes_are_small():
    """Metadata would eat the bits that stills need."""
    assert len(BASE.pack()) <= 40
    usual = replace(
        ROI, parameters={"w": 64, "h": 43, "b": U32}, also=(), codec="residual", send_delay_ns=10**8
    )
    assert len(replace(usual, capture_ns=-1).pack()) <= 62
    assert len(replace(usual, capture_ns=-1, parameters={}, codec="h264-intra").pack()) <= 50
    assert len(STEP.pack()) <= 45 + len(STEP.boxes)
    assert len(replace(STATUS, failed=(), decisions="").pack()) <= 190
    assert len(REQUEST.pack()) <= 20


def sealed(array):
    """An array with a right checksum, made without the code under test."""
    body = msgpack.packb([*array, U32])[:-5]
    return body + b"\xce" + struct.pack(">I", zlib.crc32(body))


@pytest.mark.parametrize(
    ("place", "wrong", "said"),
    [
        (6, [True], ".flags: bool in place of a whole number"),
        (6, [256], ".flags: 256 is outside 0…255"),
        (2, [[2]], ".sequence: list in place"),
        (7, range(17), " has 23 fields, not 6 to 22"),
    ],
)
def test_a_wrong_field_is_named(place, wrong, said):
    """Whoever writes another sender would search in the dark."""
    values = [WIRE_VERSION, 1, 2, 3, 4, 5, 1]
    values[place : place + 1] = wrong
    with pytest.raises(WireError, match=re.escape(f"BaseHeader{said}")):
        BaseHeader.parse(sealed(values))


def test_text_that_a_later_unicode_knows_is_read():
    """One new emoji in a class name ended the answer to ``info`` on an older Python."""
    names = ("drone \U0001fae9", "a\u200fb", "\ue000")
    assert Info.parse(replace(INFO, class_names=names).pack()).class_names == names
    assert shown_text("a\x1b\u202eb\n\U0001fae9") in ("a??b\n?", "a??b\n\U0001fae9")
    assert fitted_class_names(["a\u202eb"]) == ("a?b",)


@pytest.mark.parametrize(
    ("field", "bad", "said"),
    [
        *(("class_name", bad, ": text") for bad in ["\x1b[2J", "x" * 65, "\u202e"]),
        *(("crop_source_px", bad, ": box .* is empty") for bad in ([5, 5, 5, 9], [0, 9, 5, 9])),
        ("box_source_px", [80, 0, 8, 8], ": box .* is inside out"),
    ],
)
def test_a_still_of_the_version_before_that_would_harm_the_ground_is_refused(field, bad, said):
    """Areas divide there, and a class name could clear the operator's terminal."""
    values = {name: one.encode(getattr(ROI, name)) for name, one in kinds(RoiHeader)} | {field: bad}
    with pytest.raises(WireError, match=f"RoiHeader.{field}{said}"):
        RoiHeader.parse(sealed([V4, *values.values()]), versions=READ_VERSIONS)


def test_another_version_is_told_apart():
    """A newer edge would be reported as corrupt instead of as newer, also where ours could not read its fields."""
    for version, remedy in (
        (6, "edge uav-1 speaks wire version 6, this ground reads 5: update this ground"),
        (4, ""),
    ):
        with pytest.raises(UnknownVersionError, match=f"version {version}, only 5 is known") as other:
            BaseHeader.parse(sealed([version, "anything"]))
        said = other.value.between("edge uav-1", "this ground")
        assert said == remedy or (version == 4 and said.endswith("update edge uav-1"))
    with pytest.raises(WireError, match=r"begins with a version"):
        BaseHeader.parse(sealed([True, 1, 2, 3, 4, 5, 6]))
    for data in (b"\x92\x07\xc7\0\5\xc1", b"\xc4".join((b"\x92\x07", b"\x64" + bytes(100)))):
        with pytest.raises(UnknownVersionError, match="version 7"):
            BaseHeader.parse(data)


@pytest.mark.parametrize(
    ("bounds", "said", "in_common"),
    [
        ((6, 7), "a ground speaks wire versions 6 to 7, edge uav-1 reads 5: update edge uav-1", False),
        ((3, 4), "a ground speaks wire versions 3 to 4, edge uav-1 reads 5: update a ground", False),
        ((7, 6), "a ground speaks wire versions 7 to 6, edge uav-1 reads 5: update edge uav-1", False),
        ((4, 6), "", True),
    ],
)
@pytest.mark.parametrize("version", [WIRE_VERSION, 6])
def test_the_versions_that_a_sender_speaks_are_read_in_every_version(bounds, said, in_common, version):
    """Two sides without a version in common would show nothing, and no reason."""
    values = [version, *bounds, *msgpack.unpackb(INFO_REQUEST.pack())[3:-1]]
    if in_common and version == WIRE_VERSION:
        assert InfoRequest.parse(sealed(values)).highest_version == 6
        return
    with pytest.raises(UnknownVersionError) as other:
        InfoRequest.parse(sealed(values))
    assert other.value.in_common is in_common
    assert in_common or other.value.between("a ground", "edge uav-1") == said


def test_the_version_before_is_read():
    """What an edge has stored on its disk would be lost by an update."""
    for message in EXAMPLES:
        named = fields(cast("Any", message))
        older = replace(
            message, **{one.name: one.metadata["before"] for one in named if one.metadata["since"]}
        )
        kept = [one for one in named if not one.metadata["since"]]
        values = [one.metadata["wire"].encode(getattr(message, one.name)) for one in kept]
        assert type(message).parse(sealed([V4, *values]), versions=READ_VERSIONS) == older
        with pytest.raises(UnknownVersionError):  # nobody speaks it any more
            type(message).parse(sealed([V4, *values]))
        versions = [msgpack.unpackb(one)[0] for one in (sealed([V4, *values]), message.pack())]
        assert versions == [V4, WIRE_VERSION]


def test_our_own_values_out_of_bounds_are_a_bug_and_say_so():
    """A wrong value would be sent and refused on the other side, far from its cause."""
    with pytest.raises(ValueError, match=r"^-1 cannot be sent: -1 is outside 0…18446744073709551615"):
        BaseHeader(session_id=-1, sequence=0, frame_index=0, capture_ns=0, send_delay_ns=0, flags=0).pack()
    with pytest.raises(ValueError, match=r"^9{20} cannot be sent: [^{]*$"):
        ControlRequest(session_id=0, command="still", arguments={"frame": int("9" * 20)}).pack()
    with pytest.raises(ValueError, match=rf"at most {MAX_STILL_RESULTS} are allowed"):
        Feedback(
            **{name: getattr(FEEDBACK, name) for name, _ in kinds(Feedback) if name != "stills"},
            stills=FEEDBACK.stills * (MAX_STILL_RESULTS + 1),
        ).pack()


def test_quantised_fields_are_rounded_not_refused():
    """Boxes and confidences come with more digits than the wire carries."""
    header = replace(ROI, confidence=0.61349, box_source_px=(1.06, 2.0, 9.07, 12.99))
    parsed = RoiHeader.parse(header.pack(b"x"), b"x")
    assert (parsed.confidence, parsed.box_source_px) == (0.613, (1.0, 2.0, 9.125, 13.0))


def test_info_gives_the_view():
    """Stills would be pasted at the wrong place in the base frame."""
    view = Info.parse(INFO.pack()).view
    assert view == View.fitted((3840, 2160), (1280, 720), fit="crop")


@pytest.mark.parametrize(
    "message",
    [*MESSAGES, AlsoShown, Health, FailedPart, AcknowledgedRange, StillResult, TrackNow],
    ids=lambda message: message.__name__,
)
def test_the_document_lists_every_field_with_its_bounds(message):
    """Whoever writes a subscriber from docs/wire.md would read the wrong field."""
    section = DOCUMENT.read_text(encoding="utf-8").split(f"### `{message.__name__}`", 1)[1].split("\n#", 1)[0]
    rows = re.findall(r"^(\d+)\. `(\w+)` \((.+?)\)(?=: |$)", section, re.MULTILINE)
    first = 1 if issubclass(message, Message) else 0
    sent = StillWire if message is RoiHeader else message
    expected = [
        (str(number), name, described(kind.schema()))
        for number, (name, kind) in enumerate(kinds(sent), first)
    ]
    assert [(number, name, bounds.strip()) for number, name, bounds in rows] == expected


@given(st.integers(-I63, I63), st.integers(0, 255), st.integers(0, U32), st.binary(max_size=40))
def test_a_header_packed_once_has_the_bytes_of_one_packed_anew(delay_ns, flags, sequence, payload):
    """A still that is sent late, or again, would be refused by grounds; or the budget would count other bytes."""
    packed = PackedMessage.of(ROI).with_fields(send_delay_ns=delay_ns, flags=flags, sequence=sequence)
    anew = replace(ROI, send_delay_ns=delay_ns, flags=flags, sequence=sequence).pack(payload)
    assert packed.pack(payload) == anew
    assert packed.size_bytes == len(anew)
    with pytest.raises(ValueError, match="256"):
        packed.with_fields(flags=256)
    with pytest.raises(ValueError, match="too long"):
        packed.pack(bytes(RoiHeader.MAX_PAYLOAD + 1))
