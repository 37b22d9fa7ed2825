"""The wire format: every message there and back, and nothing but WireError for anything else."""

import contextlib
import re
import struct
import zlib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, cast

import msgpack
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import (
    MAX_PAYLOAD_BYTES,
    MAX_STILL_RESULTS,
    MOST_UNKNOWN_FIELDS,
    READ_VERSIONS,
    AcknowledgedRange,
    AlsoShown,
    BacklogHeader,
    BacklogStill,
    BacklogUnit,
    BaseHeader,
    ControlAnswer,
    ControlRequest,
    CorruptError,
    FailedPart,
    Feedback,
    Health,
    Info,
    InfoRequest,
    Message,
    PackedMessage,
    PoseReport,
    RoiHeader,
    Status,
    StillResult,
    StillWire,
    TrackNow,
    TrackStep,
    UnknownVersionError,
    WireError,
    fitted_class_names,
    kinds,
    pack_backlog_still,
    pack_backlog_units,
    parse_backlog_still,
    parse_backlog_units,
)
from hvt_common.protocol.messages.envelope import WIRE_VERSION, Nested
from hvt_common.protocol.messages.fields import (
    I63,
    U32,
    U64,
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
MESSAGES: tuple[type[Message], ...] = (
    BaseHeader,
    RoiHeader,
    TrackStep,
    PoseReport,
    Info,
    Status,
    InfoRequest,
    ControlRequest,
    ControlAnswer,
    Feedback,
    BacklogHeader,
)


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
            return st.text(st.characters(codec="utf-8").filter(str.isprintable), max_size=max_bytes // 4)
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


any_message = st.sampled_from(MESSAGES).flatmap(message_of)


@given(message=any_message, payload=st.binary(max_size=200))
@settings(max_examples=300, deadline=None)
def test_every_message_survives_the_wire(message, payload):
    """A user would see boxes, classes or counts other than those the edge meant."""
    assert type(message).parse(message.pack(payload), payload) == message


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


@given(data=st.binary(max_size=600), message=st.sampled_from(MESSAGES))
@example(data=b"", message=BaseHeader)
@example(data=b"\x91" * 600, message=Info)
@example(data=b"\x91" * 60_000, message=Info)
@example(data=b"\xdd\xff\xff\xff\xff", message=Info)
@example(data=b"\xdf\xff\xff\xff\xff", message=Status)
@example(data=b"\xc6\xff\xff\xff\xff", message=Status)
@example(data=b"\xc1", message=Status)
@example(data=b"\xd6\xff\x00\x00\x00\x00", message=Status)
@example(data=b"\xc7\x0c\xff" + b"\xff" * 12, message=Status)
@example(data=b"\x92\x01\xa2\xff\xfe", message=Feedback)
@example(data=b"\x92\x01\x81\x91\x01\x02", message=Feedback)
@example(data=b"\x91\xc3", message=BaseHeader)
@settings(max_examples=400, deadline=None)
def test_arbitrary_bytes_are_a_wire_error(data, message):
    """One hostile or broken sender would end the process."""
    with pytest.raises(WireError):
        message.parse(data, data)


nonsense = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), U64)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=30,
)


@given(values=nonsense, message=st.sampled_from(MESSAGES))
@settings(max_examples=300, deadline=None)
def test_well_formed_nonsense_with_a_good_checksum_is_a_wire_error_or_bounded(values, message):
    """A sender that packs and seals rightly but fills fields wrongly would get through."""
    data = sealed([WIRE_VERSION, *(values if isinstance(values, list) else [values])])
    try:
        parsed = message.parse(data)
    except WireError:
        return
    assert message.parse(parsed.pack()) == parsed


@given(message=any_message, payload=st.binary(max_size=60), seed=st.integers(0, 2**30))
@settings(max_examples=200, deadline=None)
def test_a_flipped_bit_is_noticed(message, payload, seed):
    """A corrupt access unit would be decoded to garbage, or a still would refine the wrong track."""
    whole = bytearray(message.pack(payload) + payload)
    length = len(whole) - len(payload)
    bit = seed % (len(whole) * 8)
    whole[bit // 8] ^= 1 << bit % 8
    with pytest.raises(WireError):
        type(message).parse(bytes(whole[:length]), bytes(whole[length:]))


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_every_truncation_and_extension_is_noticed(message):
    """Half a message would pass for a whole one."""
    data = message.pack(b"payload")
    for length in range(len(data)):
        with pytest.raises(WireError):
            type(message).parse(data[:length], b"payload")
    with pytest.raises(WireError):
        type(message).parse(data + b"\x00", b"payload")
    with pytest.raises(CorruptError):
        type(message).parse(data, b"payloa")


def sealed(array):
    """An array with a right checksum, made without the code under test."""
    body = msgpack.packb([*array, U32])[:-5]
    return body + b"\xce" + struct.pack(">I", zlib.crc32(body))


def base_fields(**changed):
    """A base header written by hand from docs/wire.md, with the given fields changed or added."""
    names = ("session_id", "sequence", "frame_index", "capture_ns", "send_delay_ns", "flags")
    return sealed([WIRE_VERSION, *(dict(zip(names, (1, 2, 3, 4, 5, 1), strict=True)) | changed).values()])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"flags": True}, ".flags: bool in place of a whole number"),
        ({"flags": 256}, ".flags: 256 is outside 0…255"),
        ({"sequence": -1}, ".sequence: -1 is outside"),
        ({"sequence": 2.0}, ".sequence: float in place of a whole number"),
        ({"sequence": "2"}, ".sequence: str in place of a whole number"),
        ({"sequence": None}, ".sequence: NoneType in place"),
        ({"sequence": [2]}, ".sequence: list in place"),
        ({"capture_ns": 2**63}, ".capture_ns: 9223372036854775808 is outside"),
        ({f"extra-{number}": 1 for number in range(17)}, " has 23 fields, not 6 to 22"),
    ],
)
def test_a_wrong_field_is_named(changed, said):
    """Whoever writes another sender would search in the dark."""
    with pytest.raises(WireError, match=re.escape(f"BaseHeader{said}")):
        BaseHeader.parse(base_fields(**changed))
    header = BaseHeader.parse(base_fields())
    assert (header.session_id, header.send_ns, header.flags) == (1, 9, 1), (
        "the independent packing is accepted"
    )


def test_text_that_a_later_unicode_knows_is_read():
    """One new emoji in a class name ended the answer to ``info`` on an older Python."""
    names = ("drone \U0001fae9", "a\u200fb", "\ue000")
    assert Info.parse(replace(INFO, class_names=names).pack()).class_names == names
    assert shown_text("a\x1b\u202eb\n\U0001fae9") in ("a??b\n?", "a??b\n\U0001fae9")
    assert fitted_class_names(["a\u202eb"]) == ("a?b",)


@pytest.mark.parametrize(
    ("message", "field", "bad", "said"),
    [
        *(
            (INFO, "fps", bad, "")
            for bad in [float("nan"), float("inf"), -float("inf"), 0.0, 1e9, 15, True, "15"]
        ),
        *((ROI, "class_name", bad, ": text") for bad in ["\x1b[2J", "a\nb", "x" * 65, "ü" * 33, "\u202e"]),
        (ROI, "crop_source_px", [5, 5, 5, 9], ": box .* is empty"),
        (ROI, "crop_source_px", [0, 9, 5, 9], ": box .* is empty"),
        (ROI, "box_source_px", [80, 0, 8, 8], ": box .* is inside out"),
    ],
)
def test_what_would_harm_the_ground_is_refused(message, field, bad, said):
    """Rates and areas divide there, and a class name could clear the operator's terminal."""
    kind = type(message)
    fields = dict(kinds(kind))
    values = {name: one.encode(getattr(message, name)) for name, one in fields.items()} | {field: bad}
    version = WIRE_VERSION if kind is Info else V4
    versions = {} if kind is Info else {"versions": READ_VERSIONS}
    with pytest.raises(WireError, match=f"{kind.__name__}.{field}{said}"):
        kind.parse(sealed([version, *values.values()]), **versions)


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


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_fields_of_a_later_minor_version_are_skipped(message):
    """Every new field would need every ground and every edge to be updated on one day."""
    sent = message.on_wire()
    values = [WIRE_VERSION, *(kind.encode(getattr(sent, name)) for name, kind in kinds(type(sent)))]
    assert type(message).parse(sealed([*values, 0])) == message
    room = type(message).MAX_BYTES - len(message.pack())
    if room > 40:
        assert type(message).parse(sealed([*values, "new", [1, {"a": None}], b"x"])) == message
    with pytest.raises(WireError, match=f"{type(message.on_wire()).__name__} has"):
        type(message).parse(sealed([*values, *[0] * (MOST_UNKNOWN_FIELDS + 1)]))
    with pytest.raises(WireError, match=r"longer than|has|more than"):
        type(message).parse(sealed([*values, bytes(type(message).MAX_BYTES)]))


def test_fields_of_a_later_minor_version_are_skipped_in_nested_arrays_too():
    """A new field of a track in a still would make the whole still unusable; other readers refuse an extension."""
    values = msgpack.unpackb(ROI.pack())[:-1]
    also, deep = values[-1], [[[[[0]]]]]
    for one in ("new", deep):
        values[-1] = [[*row, one] for row in also]
        assert RoiHeader.parse(sealed(values)) == ROI
    values[-1] = [[*row, [deep]] for row in also]
    with pytest.raises(WireError, match="nested more than 8 deep"):
        RoiHeader.parse(sealed(values))
    with pytest.raises(WireError, match="an extension of type 5"):
        BaseHeader.parse(sealed([*msgpack.unpackb(BASE.pack())[:-1], msgpack.ExtType(5, b"")]))


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


def test_arrays_in_arrays_in_place_of_a_number_are_refused_in_a_sentence():
    """A stranger's kilobyte would end the thread of an edge: Python shows nothing that is nested so deep."""
    packed = {name: msgpack.packb(kind.encode(getattr(INFO, name))) for name, kind in kinds(Info)}
    packed["fps"] = b"\x91" * 1000 + b"\x01"
    head = msgpack.Packer().pack_array_header(len(packed) + 2)
    body = b"".join((head, bytes((WIRE_VERSION,)), *packed.values()))
    data = body + b"\xce" + zlib.crc32(body).to_bytes(4, "big")
    with pytest.raises(WireError, match=r"Info is nested more than 8 deep"):
        Info.parse(data)


def test_oversized_messages_are_not_looked_at():
    """Memory would follow whatever a stranger sends."""
    with pytest.raises(WireError, match="longer than 80"):
        BaseHeader.parse(BASE.pack() + bytes(81))
    with pytest.raises(WireError, match="payload of"):
        BaseHeader.parse(BASE.pack(), bytes(MAX_PAYLOAD_BYTES + 1))


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


# What an edge kept while its link was away

stored_still = st.builds(
    BacklogStill, st.binary(max_size=1024), value_of(Text(64)), st.binary(min_size=1, max_size=300)
)
stored_units = st.lists(
    st.tuples(st.integers(0, U32), st.integers(0, I63), st.booleans(), st.binary(min_size=1, max_size=40)),
    min_size=1,
    max_size=8,
    unique_by=(lambda row: row[0], lambda row: row[1]),
).map(
    lambda rows: tuple(
        BacklogUnit(frame, at, keyframe, data)
        for frame, at, (_, _, keyframe, data) in zip(
            sorted(row[0] for row in rows), sorted(row[1] for row in rows), rows, strict=True
        )
    )
)


@given(still=stored_still, units=stored_units)
@settings(max_examples=200, deadline=None)
def test_what_was_kept_survives_the_wire(still, units):
    """What an operator sees of an outage would not be what the edge saw."""
    assert parse_backlog_still(pack_backlog_still(still)) == still
    assert parse_backlog_units(pack_backlog_units(units)) == units


@given(data=st.binary(max_size=400) | nonsense.map(msgpack.packb))
@example(data=b"")
@example(data=b"\x91" * 100_000)
@example(data=b"\xdd\xff\xff\xff\xff")
@example(data=b"\xc6\xff\xff\xff\xff")
@example(data=b"\xc7\x0c\xff" + b"\xff" * 12)
@example(data=bytes(MAX_PAYLOAD_BYTES + 1))
@settings(max_examples=400, deadline=None)
def test_any_bytes_of_a_kept_object_are_refused_or_within_bounds(data):
    """One hostile or damaged object would end the ground."""
    with contextlib.suppress(WireError):
        still = parse_backlog_still(data)
        assert len(still.attachment) <= 1024
        assert still.payload
    with contextlib.suppress(WireError):
        units = parse_backlog_units(data)
        assert 1 <= len(units) <= 2400
        assert all(
            0 <= unit.frame_index <= U32 and 0 <= unit.capture_ns <= I63 and unit.data for unit in units
        )
        assert [unit.frame_index for unit in units] == sorted({unit.frame_index for unit in units})


def test_what_was_kept_and_cannot_be_is_refused():
    """Frames out of order would freeze the viewer that plays the hole; a header be taken for something else."""
    for rows in (
        [],
        *([[1, 5, True, b""]], [[1, 5, 1, b"x"]], [[-1, 5, True, b"x"]], [[2**32, 5, True, b"x"]]),
        *([[1, 2**63, True, b"x"]], [[1, 5, True, b"x"], [1, 6, False, b"x"]], [[1, 5, True]]),
        [[1, 5, True, b"x"], [2, 5, False, b"x"]],
        [[frame, frame, False, b"x"] for frame in range(2401)],
    ):
        with pytest.raises(WireError):
            parse_backlog_units(msgpack.packb(rows))
    for values in ([], [b"", "e", b""], [b"", b"", b"x"], [bytes(1025), "", b"x"], [b"", "e" * 65, b"x"]):
        with pytest.raises(WireError):
            parse_backlog_still(msgpack.packb(values))


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
