"""Checks a model's file without any library before a runtime parses it; and reads its metadata.

A model file comes from outside. It must be a file, not too large, walk as an ONNX protobuf with a graph, and hold all
its weights: external weights make a runtime open files by the names that stand in the model (ONNX Runtime does so
even for a model given as bytes, relative to the working folder).
"""

import functools
import mmap
import os
import re
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

from hvt_common.errors import UserError, absent, telling
from hvt_common.inference.store import needed_part
from hvt_common.units import SECOND_NS

ULTRALYTICS = "metadata.yaml"
MAX_MODEL_BYTES = 1 << 30
"""1 GiB: the largest detectors are a fifth of it, and protobuf itself stops at 2 GiB."""

_DEEPEST = 100
"""Messages in messages; protobuf itself stops here."""
_EXTERNAL = 1
"""`TensorProto.DataLocation`."""

# Field numbers of ModelProto in onnx.proto.
_MODEL_FIELDS = frozenset({1, 2, 3, 4, 5, 6, 7, 8, 14, 20, 25, 26})
_VERSION_FIELD, _PRODUCER_FIELD, _PRODUCER_VERSION_FIELD = 1, 2, 3
GRAPH_FIELD = 7
_OPSET_FIELD = 8
_METADATA_FIELD = 14
# Fields of onnx.proto that lead to tensors: message → field number → message.
_INSIDE: Mapping[str, Mapping[int, str]] = MappingProxyType(
    {
        "Model": {7: "Graph", 20: "Training", 25: "Function"},
        "Training": {1: "Graph", 2: "Graph"},
        "Function": {7: "Node", 11: "Attribute"},
        "Graph": {1: "Node", 5: "Tensor", 15: "Sparse"},
        "Node": {5: "Attribute"},
        "Attribute": {5: "Tensor", 6: "Graph", 10: "Tensor", 11: "Graph", 22: "Sparse", 23: "Sparse"},
        "Sparse": {1: "Tensor", 2: "Tensor"},
        "Tensor": {},
    }
)
_TENSOR_EXTERNAL_DATA, _TENSOR_DATA_LOCATION = 13, 14
_FIXED_BYTES = {1: 8, 5: 4}

_OTHERS: Mapping[bytes, str] = MappingProxyType(
    {
        rb"version https://git-lfs": "but Git LFS's pointer to one: git lfs pull brings it",
        rb"\s*<[!?a-zA-Z]": "but a web page or XML",
        rb"PK\x03\x04": "but a zip archive, as PyTorch's .pt is: export it as ONNX",
        rb"....TFL3": "but TensorFlow Lite's: export it as ONNX",
        rb"\x89HDF": "but Keras's: export it as ONNX",
    }
)
"""Files that are given by mistake, by their first bytes."""

_YOUNG_NS = 2 * SECOND_NS
"""Within that a file may be written again without another time: that is of 10 ms, or of 2 s (FAT)."""

_Bytes = bytes | mmap.mmap


def check_onnx_file(path: Path) -> None:
    """Raise `UserError` in one sentence if it is certainly no ONNX model, or not a whole one."""
    if not path.exists():
        raise absent(path)(f"model {path} does not exist; an ONNX file is expected")
    if not path.is_file():
        raise UserError(f"model {path} is not a file; an ONNX file is expected")
    with telling(f"model {path} cannot be read (", "): name a file that can"):
        status = path.stat()
        young = time.time_ns() - status.st_mtime_ns < _YOUNG_NS
        check = _check_file.__wrapped__ if young else _check_file
        check(path, (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns))


def opset_versions(path: Path) -> dict[str, int]:
    """The version of each operator set that a checked model imports, by domain; "" is ONNX itself."""
    # An OperatorSetIdProto: domain is field 1, version field 2.
    sets = (_entry(data) for field, _, data in _top_fields(path) if field == _OPSET_FIELD)
    return {text(one.get(1, (0, b""))[1]): one.get(2, (0, b""))[0] for one in sets}


def onnx_version(path: Path) -> tuple[int, str]:
    """The version of the file format (IR version) of a checked model, and who wrote it."""
    version, producer = 0, ""
    for field, value, data in _top_fields(path):
        if field == _VERSION_FIELD:
            version = value
        elif field in (_PRODUCER_FIELD, _PRODUCER_VERSION_FIELD):
            producer = f"{producer} {text(data[:80])}".strip()
    return version, producer


def onnx_metadata(path: Path) -> dict[str, str]:
    """The metadata that the exporter wrote into a model. Raises `UserError` as `check_onnx_file` does."""
    check_onnx_file(path)
    # A StringStringEntryProto: key is field 1, value field 2.
    said = (_entry(data) for field, _, data in _top_fields(path) if field == _METADATA_FIELD)
    return {text(one.get(1, (0, b""))[1]): text(one.get(2, (0, b""))[1]) for one in said}


def _top_fields(path: Path) -> Iterator[tuple[int, int, bytes]]:
    # Number, value (of a varint) and bytes of the fields of a checked model, but for the graph, which is large.
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for field, _, value, begin, end in fields_of(data, 0, len(data)):
            if field != GRAPH_FIELD:
                yield field, value, data[begin:end]


@functools.lru_cache(maxsize=16)
def _check_file(path: Path, version: tuple[int, ...]) -> None:
    # Once for each ``version`` of a file, of four that ask while a detector is opened; its time may be set back.
    del version
    with path.open("rb") as file:
        size_bytes = os.fstat(file.fileno()).st_size
        if size_bytes > MAX_MODEL_BYTES:
            raise UserError(f"model {path} has {size_bytes} bytes; at most {MAX_MODEL_BYTES} are accepted")
        if not size_bytes:
            raise UserError(f"model {path} is not an ONNX file (it is empty)")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            _check(path, data)


def _check(path: Path, data: mmap.mmap) -> None:
    try:
        fields = set(_model_fields(data))
        location = _external_location(data, 0, len(data), "Model", depth=0)
    except ValueError as error:
        known = (word for mark, word in _OTHERS.items() if re.match(mark, data[:64], re.DOTALL))
        what = next(known, f"or is cut short ({error})")
        raise UserError(f"model {path} is not an ONNX file, {what}") from error
    if GRAPH_FIELD not in fields:
        raise UserError(f"model {path} is not an ONNX file (no graph in it)")
    if location is not None:
        raise UserError(
            f"model {path} cannot be opened: it keeps weights in another file ({location!r:.80}); make it one file: "
            "external_data=False in torch.onnx.export, or onnx.save(onnx.load(OLD), NEW)"
        )


def _model_fields(data: _Bytes) -> Iterator[int]:
    for field, wire_type, _, begin, _ in fields_of(data, 0, len(data)):
        if field not in _MODEL_FIELDS or wire_type not in (0, 2):
            raise ValueError(f"unknown field {field} of type {wire_type} before byte {begin}")
        yield field


def _external_location(data: _Bytes, start: int, end: int, kind: str, *, depth: int) -> str | None:
    # Where the first tensor with data outside the file says that they are; None where there is none.
    if depth > _DEEPEST:
        raise ValueError(f"messages nested {depth} deep")
    if kind == "Tensor":
        return _tensor_location(data, start, end)
    for field, wire_type, _, begin, stop in fields_of(data, start, end):
        inner = _INSIDE[kind].get(field)
        if inner is not None and wire_type == 2:
            location = _external_location(data, begin, stop, inner, depth=depth + 1)
            if location is not None:
                return location
    return None


def _tensor_location(data: _Bytes, start: int, end: int) -> str | None:
    external, location = False, ""
    for field, wire_type, value, begin, stop in fields_of(data, start, end):
        if field == _TENSOR_DATA_LOCATION and wire_type == 0:
            external = value == _EXTERNAL
        elif field == _TENSOR_EXTERNAL_DATA and wire_type == 2:
            external = True
            entry = _entry(data[begin:stop])
            if entry.get(1, (0, b""))[1] == b"location":
                location = text(entry.get(2, (0, b""))[1][:200])
    return location if external else None


def _entry(data: bytes) -> dict[int, tuple[int, bytes]]:
    # Value (of a varint) and bytes of each field of a small message, by number.
    return {field: (value, data[a:b]) for field, _, value, a, b in fields_of(data, 0, len(data))}


def text(data: bytes) -> str:
    """Text of a model, which may be anything."""
    return data.decode(errors="replace")


def fields_of(data: _Bytes, start: int, end: int) -> Iterator[tuple[int, int, int, int, int]]:
    # Number, wire type, value (of a varint), begin and end of each field of a message; ValueError if malformed.
    at = start
    while at < end:
        head = data[at : min(end, at + 20)]
        tag, used = _varint(head, 0)
        wire_type, value, begin = tag & 7, 0, at + used
        if wire_type == 0:
            value, after = _varint(head, used)
            stop = at + after
        elif wire_type == 2:
            length, after = _varint(head, used)
            begin = at + after
            stop = begin + length
        elif wire_type in _FIXED_BYTES:
            stop = begin + _FIXED_BYTES[wire_type]
        else:
            raise ValueError(f"unknown wire type {wire_type} at byte {at}")
        if stop > end:
            raise ValueError(f"field {tag >> 3} ends {stop - end} bytes past the end")
        yield tag >> 3, wire_type, value, begin, stop
        at = stop


def _varint(data: bytes, start: int) -> tuple[int, int]:
    # Decode a protobuf varint: (value, position after it).
    value = 0
    for count, byte in enumerate(data[start : start + 10]):
        value |= (byte & 0x7F) << (7 * count)
        if byte < 0x80:
            return value, start + count + 1
    raise ValueError("a number without an end")


def is_ir(path: Path) -> bool:
    """Whether a file is meant as an OpenVINO model, by its name; the model library reads it."""
    return path.suffix.lower() == ".xml"


def files_of(path: Path) -> tuple[Path, ...]:
    """The files of a model: itself, and beside an IR its weights and the metadata of Ultralytics."""
    said = path.with_name(ULTRALYTICS)
    return (path, path.with_suffix(".bin"), *[said] * said.is_file()) if is_ir(path) else (path,)


def metadata_of(path: Path) -> dict[str, str]:
    """The metadata of a model, by ONNX's names. Raises `UserError` where it is none, or the library is missing."""
    if not is_ir(path):
        return onnx_metadata(path)
    metadata: dict[str, str] = needed_part("openvino", f"model {path}").metadata(path)
    return metadata
