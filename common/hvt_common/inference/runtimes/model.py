"""ONNX models, on onnxruntime or another runtime: the only file that imports onnxruntime.

A model file comes from outside, so it is looked at before onnxruntime sees it: it must be a file, not too large,
its bytes must walk as an ONNX protobuf with a graph in it, and all its weights must be in it. What it declares has
bounds, too. It is read as ONNX whatever its name ends in, and no custom operator library is ever registered. A
model that another runtime will run is opened by onnxruntime first all the same: it says the ports and the metadata,
and no runtime gets a file that onnxruntime refuses.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
import numpy.typing as npt
import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from hvt_common.errors import UserError
from hvt_common.inference.runtimes.external_weights import external_weights, read_varint
from hvt_common.inference.runtimes.openvino_model import OpenVinoRunner, find_openvino
from hvt_common.inference.runtimes.providers import ONNXRUNTIME_PROVIDERS, ProviderChoice, choose_provider

__all__ = ["MAX_MODEL_BYTES", "ModelSettings", "OnnxModel", "Port", "open_model", "opset_versions"]

_log = logging.getLogger(__name__)

MAX_MODEL_BYTES = 1 << 30
"""1 GiB: the largest detectors are a fifth of it, and protobuf itself stops at 2 GiB."""

_MOST_PORTS = 64
_MOST_AXES = 8
_MOST_ELEMENTS = 1 << 26
"""Of one input or output with its free sizes taken as 1: 256 MiB of float32, a picture of 4096x4096 and more."""

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
_OPSET_FIELD = 8


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """How a model is run."""

    threads: int = 2
    """CPU threads inside one operator, 1 or more."""
    provider: str = "cpu"
    """One of `hvt_common.inference.runtimes.providers.PROVIDERS`."""


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


class _Runner(Protocol):
    def run(self, feed: npt.NDArray[Any]) -> list[npt.NDArray[Any]]: ...


class OnnxModel:
    """An opened ONNX model; made by `open_model`.

    Attributes:
        path: The file, for messages.
        inputs, outputs: The ports as the file declares them.
        metadata: What the exporter wrote into the file.
        provider: What runs it, and why.
    """

    def __init__(
        self, path: Path, session: ort.InferenceSession, *, runner: _Runner, provider: ProviderChoice
    ) -> None:
        self.path = path
        self.inputs = tuple(_port(value) for value in session.get_inputs())
        self.outputs = tuple(_port(value) for value in session.get_outputs())
        self.metadata: dict[str, str] = dict(session.get_modelmeta().custom_metadata_map)
        self.provider = provider
        self._runner = runner

    def run(self, feed: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Run the model on its only input; return its outputs in their declared order.

        Raises:
            UserError: This model cannot run on an input of this shape.
        """
        port = self.inputs[0]
        if len(feed.shape) != len(port.shape) or any(
            size not in (None, given) for size, given in zip(port.shape, feed.shape, strict=True)
        ):
            shape = "x".join(map(str, feed.shape))
            raise UserError(f"model {self.path} does not run on a {shape} input: it takes {port}")
        return self._runner.run(feed)


class _OnnxRuntimeRunner:
    def __init__(self, path: Path, session: ort.InferenceSession) -> None:
        self._path = path
        self._session = session
        self._input_name = session.get_inputs()[0].name if session.get_inputs() else ""
        self._output_names = [port.name for port in session.get_outputs()]

    def run(self, feed: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        try:
            outputs: list[npt.NDArray[Any]] = self._session.run(self._output_names, {self._input_name: feed})
        except _ORT_ERRORS as error:
            shape = "x".join(map(str, feed.shape))
            raise UserError(
                f"model {self._path} does not run on a {shape} input: {_reason(error)}"
            ) from error
        return outputs


def open_model(path: Path, *, settings: ModelSettings | None = None) -> OnnxModel:
    """Open an ONNX file; what runs it is logged, with the reason.

    Raises:
        UserError: No such file, too large, not an ONNX model, one that the runtime cannot load, or a provider that is
            unknown, not installed or cannot start.
    """
    settings = settings or ModelSettings()
    choice = choose_provider(
        settings.provider, onnxruntime=ort.get_available_providers(), openvino=find_openvino
    )
    _check_file(path)
    try:
        model = _open(path, settings, choice)
    except UserError as error:
        if choice.asked or choice.provider == "cpu":
            raise
        model = _open(path, settings, ProviderChoice("cpu", str(error), asked=False))
    except UnicodeDecodeError as error:  # a name in the file, or the runtime's message that quotes it
        raise UserError(f"model {path} cannot be opened: a name in it is not text") from error
    _log.info("%s runs on %s: %s", path.name, model.provider.provider, model.provider.why)
    return model


def _open(path: Path, settings: ModelSettings, choice: ProviderChoice) -> OnnxModel:
    if choice.provider == "openvino":
        described = _session(path, settings, ("CPUExecutionProvider",), optimised=False)
        found = find_openvino()
        runner = OpenVinoRunner(path, threads=settings.threads, bf16=found is not None and found.bf16)
        return OnnxModel(path, described, runner=runner, provider=choice)
    names = ONNXRUNTIME_PROVIDERS[choice.provider]
    session = _session(path, settings, names)
    if session.get_providers()[0] != names[0]:
        raise UserError(
            f"--provider {choice.provider} did not start (its driver or libraries are missing): choose cpu"
        )
    return OnnxModel(path, session, runner=_OnnxRuntimeRunner(path, session), provider=choice)


def _session(
    path: Path, settings: ModelSettings, providers: tuple[str, ...], *, optimised: bool = True
) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = settings.threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    if not optimised:
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    # Threads that spin between runs burn the cores that the encoder needs: half the CPU time for no gain.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # A file that ends in .ort would go to another parser.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        # Without its own fallback, which tries the same again and prints banners.
        session = ort.InferenceSession(str(path), options, providers=list(providers), enable_fallback=0)
    except _ORT_ERRORS as error:
        raise UserError(f"model {path} cannot be opened: {_reason(error)}") from error
    _check_ports(path, session)
    return session


def _check_ports(path: Path, session: ort.InferenceSession) -> None:
    """Refuse a model whose ports nobody could feed or read."""
    for side, ports in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
        if not 1 <= len(ports) <= _MOST_PORTS:
            raise UserError(f"model {path} has {len(ports)} {side}; 1 to {_MOST_PORTS} are accepted")
        for port in map(_port, ports):
            elements = math.prod(size or 1 for size in port.shape)
            if len(port.shape) > _MOST_AXES or elements > _MOST_ELEMENTS:
                raise UserError(
                    f"model {path} declares {port.name!r:.40} with {len(port.shape)} axes and {elements:.3g} "
                    f"numbers; at most {_MOST_AXES} axes and {_MOST_ELEMENTS} numbers are accepted"
                )


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
                fields = {field for field, _, _ in _top_level_fields(file, size_bytes)}
            except ValueError as error:
                raise UserError(f"model {path} is not an ONNX file, or is cut short ({error})") from error
    except OSError as error:
        raise UserError(f"model {path} cannot be read: {error.strerror}") from error
    if _GRAPH_FIELD not in fields:
        raise UserError(f"model {path} is not an ONNX file (no graph in it)")
    _check_whole(path)


def _check_whole(path: Path) -> None:
    try:
        elsewhere = external_weights(path)
    except ValueError as error:
        raise UserError(f"model {path} is not an ONNX file, or is damaged ({error})") from error
    except OSError as error:
        raise UserError(f"model {path} cannot be read: {error.strerror}") from error
    if elsewhere is not None:
        raise UserError(
            f"model {path} cannot be opened: it keeps weights in another file ({elsewhere!r:.80}); make it one file: "
            "external_data=False in torch.onnx.export, or onnx.save(onnx.load(OLD), NEW)"
        )


def opset_versions(path: Path) -> dict[str, int]:
    """The version of each operator set that a model imports, by domain; "" is ONNX itself.

    Raises:
        UserError: Not an ONNX model.
    """
    _check_file(path)
    versions = {}
    with path.open("rb") as file:
        for field, start, end in list(_top_level_fields(file, path.stat().st_size)):
            if field == _OPSET_FIELD:
                file.seek(start)
                domain, version = _opset(file.read(end - start))
                versions[domain] = version
    return versions


def _opset(data: bytes) -> tuple[str, int]:
    """Decode an OperatorSetIdProto: domain is field 1, version field 2."""
    domain, version, position = "", 0, 0
    while position < len(data):
        tag, position = read_varint(data, position)
        value, position = read_varint(data, position)
        if tag == 0x0A:
            domain = data[position : position + value].decode(errors="replace")
            position += value
        elif tag == 0x10:
            version = value
        else:
            break
    return domain, version


def _top_level_fields(file: BinaryIO, size_bytes: int) -> Iterator[tuple[int, int, int]]:
    """Field number, start and end of each field of a serialised ModelProto; ValueError where it is no such thing.

    The contents are passed over, so a large file costs a few seeks.
    """
    position = 0
    while position < size_bytes:
        file.seek(position)
        head = file.read(20)
        tag, used = read_varint(head, 0)
        field, wire_type = tag >> 3, tag & 7
        if field not in _MODEL_FIELDS:
            raise ValueError(f"unknown field {field} at byte {position}")
        start = position
        if wire_type == 0:
            start += used
            _, used = read_varint(head, used)
        elif wire_type == 2:
            length, used = read_varint(head, used)
            start += used
            used += length
        else:
            raise ValueError(f"unknown wire type {wire_type} at byte {position}")
        position += used
        if position > size_bytes:
            raise ValueError(f"field {field} ends {position - size_bytes} bytes past the end")
        yield field, start, position
