"""ONNX models: the only file that imports onnxruntime.

A model file comes from outside, so it is looked at before onnxruntime sees it: it must be a file, not too large,
and its bytes must walk as an ONNX protobuf with a graph in it. No custom operator library is ever registered, and
onnxruntime itself refuses external weights that lie outside the folder of the model (a test holds it to that).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from hvt_common.errors import UserError

__all__ = ["MAX_MODEL_BYTES", "ModelSettings", "OnnxModel", "Port", "open_model"]

MAX_MODEL_BYTES = 1 << 30
"""1 GiB: the largest detectors are a fifth of it, and protobuf itself stops at 2 GiB."""

_ELEMENT_TYPES: Mapping[str, npt.DTypeLike] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
}
_ORT_ERRORS: tuple[type[Exception], ...] = tuple(
    getattr(ort_errors, name)
    for name in (
        "EPFail",
        "EngineError",
        "Fail",
        "InvalidArgument",
        "InvalidGraph",
        "InvalidProtobuf",
        "ModelLoaded",
        "NoModel",
        "NoSuchFile",
        "NotImplemented",
        "RuntimeException",
    )
)
# Field numbers of ModelProto in onnx.proto, and the one that holds the graph.
_MODEL_FIELDS = frozenset({1, 2, 3, 4, 5, 6, 7, 8, 14, 20, 25, 26})
_GRAPH_FIELD = 7


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """How a model is run."""

    threads: int = 2
    """CPU threads inside one operator, 1 or more."""
    providers: tuple[str, ...] = ("CPUExecutionProvider",)
    """onnxruntime execution providers, the first that is able takes each operator."""


@dataclass(frozen=True, slots=True)
class Port:
    """One input or output of a model."""

    name: str
    shape: tuple[int | None, ...]
    """None where the size is free."""
    dtype: np.dtype[Any] | None
    """None for what is not a plain tensor of numbers."""

    def __str__(self) -> str:
        sizes = ", ".join("?" if size is None else str(size) for size in self.shape)
        return f"{self.name} ({sizes}) {self.dtype if self.dtype is not None else 'not a tensor'}"


class OnnxModel:
    """An opened ONNX model.

    Args:
        path: The file, for messages.
        session: The onnxruntime session, made by `open_model`.
    """

    def __init__(self, path: Path, session: ort.InferenceSession) -> None:
        self.path = path
        self.inputs = tuple(_port(value) for value in session.get_inputs())
        self.outputs = tuple(_port(value) for value in session.get_outputs())
        self.metadata: dict[str, str] = dict(session.get_modelmeta().custom_metadata_map)
        self._session = session
        self._output_names = [port.name for port in self.outputs]

    def run(self, feed: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Run the model on its only input; return its outputs in their declared order.

        Raises:
            UserError: onnxruntime cannot run this model on an input of this shape.
        """
        try:
            outputs: list[npt.NDArray[Any]] = self._session.run(
                self._output_names, {self.inputs[0].name: feed}
            )
        except _ORT_ERRORS as error:
            shape = "x".join(map(str, feed.shape))
            raise UserError(f"model {self.path} does not run on a {shape} input: {_reason(error)}") from error
        return outputs


def open_model(path: Path, *, settings: ModelSettings | None = None) -> OnnxModel:
    """Open an ONNX file.

    Raises:
        UserError: No such file, too large, not an ONNX model, or one that onnxruntime cannot load.
    """
    settings = settings or ModelSettings()
    _check_file(path)
    options = ort.SessionOptions()
    options.intra_op_num_threads = settings.threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Threads that spin between runs burn the cores that the encoder needs: half the CPU time for no gain.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = ort.InferenceSession(str(path), options, providers=list(settings.providers))
    except _ORT_ERRORS as error:
        raise UserError(f"model {path} cannot be opened: {_reason(error)}") from error
    return OnnxModel(path, session)


def _port(value: Any) -> Port:
    element = _ELEMENT_TYPES.get(value.type)
    shape = tuple(size if isinstance(size, int) and size > 0 else None for size in value.shape or ())
    return Port(value.name, shape, None if element is None else np.dtype(element))


def _reason(error: Exception) -> str:
    """The first line of onnxruntime's message without its code prefix, at most 200 characters."""
    lines = str(error).strip().splitlines()
    return (lines[0] if lines else type(error).__name__).rpartition("] : ")[2][:200]


def _check_file(path: Path) -> None:
    """Refuse, in one sentence, what is certainly no ONNX model, before onnxruntime parses it."""
    if not path.exists():
        raise UserError(f"model {path} does not exist; an ONNX file is expected")
    if not path.is_file():
        raise UserError(f"model {path} is not a file; an ONNX file is expected")
    try:
        with path.open("rb") as file:
            size_bytes = os.fstat(file.fileno()).st_size
            if size_bytes > MAX_MODEL_BYTES:
                raise UserError(
                    f"model {path} has {size_bytes} bytes; at most {MAX_MODEL_BYTES} are accepted"
                )
            try:
                fields = set(_top_level_fields(file, size_bytes))
            except ValueError as error:
                raise UserError(f"model {path} is not an ONNX file, or is cut short ({error})") from error
    except OSError as error:
        raise UserError(f"model {path} cannot be read: {error.strerror}") from error
    if _GRAPH_FIELD not in fields:
        raise UserError(f"model {path} is not an ONNX file (no graph in it)")


def _top_level_fields(file: BinaryIO, size_bytes: int) -> Iterator[int]:
    """Field numbers of a serialised ModelProto without its contents; ValueError where the bytes are no such thing."""
    position = 0
    while position < size_bytes:
        file.seek(position)
        head = file.read(20)
        tag, used = _varint(head, 0)
        field, wire_type = tag >> 3, tag & 7
        if field not in _MODEL_FIELDS:
            raise ValueError(f"unknown field {field} at byte {position}")
        if wire_type == 0:
            _, used = _varint(head, used)
        elif wire_type == 2:
            length, used = _varint(head, used)
            used += length
        else:
            raise ValueError(f"unknown wire type {wire_type} at byte {position}")
        position += used
        if position > size_bytes:
            raise ValueError(f"field {field} ends {position - size_bytes} bytes past the end")
        yield field


def _varint(data: bytes, start: int) -> tuple[int, int]:
    """Decode a protobuf varint: (value, position after it)."""
    value = 0
    for count, byte in enumerate(data[start : start + 10]):
        value |= (byte & 0x7F) << (7 * count)
        if byte < 0x80:
            return value, start + count + 1
    raise ValueError("a number without an end")
