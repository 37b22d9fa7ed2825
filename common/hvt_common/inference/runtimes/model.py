"""Models, on onnxruntime or another runtime: the only file that imports onnxruntime.

A model file comes from outside: `model_file` checks it first and bounds its declarations. It is read as ONNX
whatever its name ends in, and no custom operator library is registered. A model that another runtime will run is
opened by onnxruntime first: that gives ports and metadata, and no runtime gets a file that onnxruntime refuses. An
OpenVINO model (``.xml``) is run by OpenVINO alone.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.letterbox import OwnSteps
from hvt_common.inference.runtimes.model_file import check_onnx_file, is_ir, onnx_version, opset_versions
from hvt_common.inference.runtimes.providers import (
    ONNXRUNTIME_PROVIDERS,
    OpenVinoCpu,
    ProviderChoice,
    choose_provider,
)
from hvt_common.inference.store import ModelStore, library_part, needed_part

if TYPE_CHECKING:
    import onnxruntime as ort

_log = logging.getLogger(__name__)

_MOST_PORTS = 64
_MOST_AXES = 8
_MOST_ELEMENTS = 1 << 26
"""Limit of one input or output with its free sizes taken as 1: 256 MiB of float32, a picture of 4096x4096."""

TRAINED_HERE = "hvt.training_commit"
"""In the metadata of a network that was trained here."""
_MOST_CHARS = 300
_ARENA_BYTES = 128 << 20
LIGHT_BYTES = 8_000_000
"""A smaller file is a light network: the embedded ones, YOLOX-nano. OpenVINO alone takes more memory than it."""

_ORT_ERRORS = (
    *("EPFail", "EngineError", "Fail", "InvalidArgument", "InvalidGraph", "InvalidProtobuf", "ModelLoaded"),
    *("NoModel", "NoSuchFile", "NotImplemented", "RuntimeException"),
)


def _onnxruntime() -> ModuleType:
    # Loaded with the first model: 20 MB that a flight of video alone does without.
    import onnxruntime  # noqa: PLC0415

    module: ModuleType = onnxruntime
    return module


@cache
def _shares_arena() -> bool:
    # From pieces that double, 1100x720 takes 32 MB more, and each one that is full wastes some: untouched ones none.
    runtime = _onnxruntime()
    where = runtime.OrtMemoryInfo(
        "Cpu", runtime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, runtime.OrtMemType.DEFAULT
    )
    try:
        how = runtime.OrtArenaCfg(
            {"initial_chunk_size_bytes": _ARENA_BYTES, "max_dead_bytes_per_chunk": 1 << 20}
        )
        runtime.create_and_register_allocator(where, how)
    except _ort_errors():  # the program around us has one already
        return False
    return True


@cache
def _ort_errors() -> tuple[type[Exception], ...]:
    errors = _onnxruntime().capi.onnxruntime_pybind11_state
    return tuple(getattr(errors, name) for name in _ORT_ERRORS)


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """Settings of a model's run."""

    threads: int = 1
    """CPU threads inside one operator, 1 or more: the caller's, and workers of the priority of the opener."""
    provider: str = "cpu"
    """One of `hvt_common.inference.runtimes.providers.PROVIDERS`."""


@dataclass(frozen=True, slots=True)
class Port:
    """One input or output of a model."""

    name: str
    shape: tuple[int | None, ...]
    """None where the size is free."""
    dtype: np.dtype[Any] | None
    """None for anything but a plain tensor of numbers."""

    def __str__(self) -> str:
        sizes = ", ".join("?" if size is None else str(size) for size in self.shape)
        return f"{self.name} ({sizes}) {self.dtype if self.dtype is not None else 'of a type not known here'}"


class _Runner(Protocol):
    def run(self, feed: npt.NDArray[Any], *more: npt.NDArray[Any]) -> list[npt.NDArray[Any]]: ...


@dataclass(eq=False)
class OnnxModel:
    """An opened ONNX model; made by `open_model`."""

    path: Path
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    metadata: Mapping[str, str]
    """Written into the file by the exporter."""
    runner: _Runner
    provider: ProviderChoice
    """The provider that runs it, with the reason."""

    def run(self, feed: npt.NDArray[Any], *more: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Run the model on its inputs, mostly one; return its outputs in their declared order.

        Raises `UserError` where this model cannot run on an input of this shape.
        """
        port = self.inputs[0]
        if len(feed.shape) != len(port.shape) or any(
            size not in (None, given) for size, given in zip(port.shape, feed.shape, strict=True)
        ):
            shape = "x".join(map(str, feed.shape))
            raise UserError(f"model {self.path} does not run on a {shape} input: it takes {port}")
        return self.runner.run(feed, *more)


class _OnnxRuntimeRunner:
    def __init__(self, path: Path, session: ort.InferenceSession) -> None:
        self._path = path
        self._session = session
        self._input_names = [port.name for port in session.get_inputs()]
        self._output_names = [port.name for port in session.get_outputs()]

    def run(self, feed: npt.NDArray[Any], *more: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        feeds = dict(zip(self._input_names, (feed, *more), strict=False))
        try:
            outputs: list[npt.NDArray[Any]] = self._session.run(self._output_names, feeds)
        except _ort_errors() as error:
            shape = "x".join(map(str, feed.shape))
            raise UserError(
                f"model {self._path} does not run on a {shape} input: {_reason(error)}"
            ) from error
        return outputs


def open_model(path: Path, *, settings: ModelSettings | None = None) -> OnnxModel:
    """Open an ONNX file, or OpenVINO's ``.xml``; the provider is logged, with the reason.

    Raises `UserError` where there is no such file, or it is too large, no ONNX model or one that the runtime
    cannot load; or for a provider that is unknown, not installed or cannot start.
    """
    settings = settings or ModelSettings()
    if is_ir(path):
        return cast("OnnxModel", needed_part("openvino", f"model {path}").open_ir(path, settings))
    choice = provider_here(settings.provider, light=path.is_file() and path.stat().st_size < LIGHT_BYTES)
    check_onnx_file(path)
    try:
        model = _open(path, settings, choice)
        if choice.provider == "openvino" and not choice.explicit and len(model.inputs) == 1:
            plain = _open(path, settings, ProviderChoice("cpu", "", explicit=False))
            model = cast("OnnxModel", needed_part("openvino", f"model {path}").quicker(model, plain))
    except UserError as error:
        if choice.explicit or choice.provider == "cpu":
            raise
        model = _open(path, settings, ProviderChoice("cpu", str(error), explicit=False))
    except UnicodeDecodeError as error:  # a name in the file, or the runtime's message that quotes it
        raise UserError(f"model {path} cannot be opened: a name in it is not text") from error
    _log.info("%s runs on %s: %s", path.name, model.provider.provider, model.provider.why)
    return model


def provider_here(wanted: str, *, light: bool = False) -> ProviderChoice:
    """`choose_provider` among those that are installed."""
    known = _onnxruntime().get_available_providers()
    return choose_provider(wanted, onnxruntime=known, openvino=find_openvino, light=light)


def find_openvino() -> OpenVinoCpu | None:
    """The OpenVINO that is installed, if the model library is too: one of its parts runs it. Looking takes 0.2 s."""
    part = library_part("openvino")
    return None if part is None else cast("OpenVinoCpu | None", part.find())


def _open(path: Path, settings: ModelSettings, choice: ProviderChoice) -> OnnxModel:
    runner: _Runner
    if choice.provider == "openvino":
        session = _session(path, settings, ("CPUExecutionProvider",), optimised=False)
        found = find_openvino()
        bf16 = found is not None and found.bf16
        runner = needed_part("openvino", f"model {path}")(path, threads=settings.threads, bf16=bf16)
    else:
        names = ONNXRUNTIME_PROVIDERS[choice.provider]
        session = _session(path, settings, names)
        if session.get_providers()[0] != names[0]:
            raise UserError(
                f"--provider {choice.provider} did not start (its driver or libraries are missing): choose cpu"
            )
        runner = _OnnxRuntimeRunner(path, session)
    inputs, outputs = _ports(session)
    metadata = session.get_modelmeta().custom_metadata_map
    return OnnxModel(path, inputs, outputs, metadata=metadata, runner=runner, provider=choice)


def own_steps(model: OnnxModel) -> OwnSteps:
    """The first steps on its pixels of a model, as the model library reads them; most have none.

    Without the library a model says its pixels, or was trained here; else raises `UserError`: pixels that are scaled
    twice show nothing, and say so to nobody.
    """
    known = {TRAINED_HERE} <= model.metadata.keys() or {"hvt.mean", "hvt.scale"} <= model.metadata.keys()
    library = library_part("store") if known else needed_part("store", f"model {model.path}")
    return OwnSteps() if library is None else cast("type[ModelStore]", library).own_steps(model.path)


def _ports(session: ort.InferenceSession) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    return tuple(map(_port, session.get_inputs())), tuple(map(_port, session.get_outputs()))


def _session(
    path: Path, settings: ModelSettings, providers: tuple[str, ...], *, optimised: bool = True
) -> ort.InferenceSession:
    runtime = _onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = settings.threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # A plan of all tensors for each input shape takes 35 MB more than an arena that reuses them, and saves no time.
    options.enable_mem_pattern = False
    if _shares_arena():
        options.add_session_config_entry("session.use_env_allocators", "1")
    if not optimised:
        options.graph_optimization_level = runtime.GraphOptimizationLevel.ORT_DISABLE_ALL
    # Threads that spin between runs burn the cores that the encoder needs: half the CPU time for no gain.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # A file that ends in .ort would go to another parser.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        # Without its own fallback, which tries the same again and prints banners.
        session: ort.InferenceSession = runtime.InferenceSession(
            str(path), options, providers=list(providers), enable_fallback=0
        )
    except _ort_errors() as error:
        raise UserError(f"model {path} cannot be opened: {_cause(path, error)}") from error
    except TypeError:
        raise UserError(f"model {path} cannot be opened: its name is not UTF-8, rename it") from None
    for value in (*session.get_inputs(), *session.get_outputs()):
        if not value.type.startswith("tensor("):
            raise UserError(
                f"model {path} has {value.name!r:.40}, a {value.type:.80}; tensors are accepted: export it without"
                " ZipMap, or without lists"
            )
    check_ports(path, *_ports(session))
    return session


def check_ports(path: Path, inputs: tuple[Port, ...], outputs: tuple[Port, ...]) -> None:
    """Raise `UserError` for more ports, axes or numbers than are accepted."""
    for side, ports in (("inputs", inputs), ("outputs", outputs)):
        if not 1 <= len(ports) <= _MOST_PORTS:
            raise UserError(f"model {path} has {len(ports)} {side}; 1 to {_MOST_PORTS} are accepted")
        for port in ports:
            elements = math.prod(size or 1 for size in port.shape)
            if len(port.shape) > _MOST_AXES or elements > _MOST_ELEMENTS:
                raise UserError(
                    f"model {path} declares {port.name!r:.40} with {len(port.shape)} axes and {elements:.3g} "
                    f"numbers; at most {_MOST_AXES} axes and {_MOST_ELEMENTS} numbers are accepted"
                )


def _port(value: Any) -> Port:
    element = value.type.removeprefix("tensor(").rstrip(")")
    try:
        dtype = np.dtype("float32" if element == "float" else element)
    except TypeError:  # text, or numbers that NumPy does not have, as bfloat16
        dtype = None
    shape = tuple(size if isinstance(size, int) and size > 0 else None for size in value.shape or ())
    return Port(value.name, shape, dtype)


def _cause(path: Path, error: Exception) -> str:
    # Why onnxruntime does not open a file: the version found, the version supported here, and the remedy.
    text = " ".join(str(error).split())
    try:
        (version, producer), opset = onnx_version(path), opset_versions(path).get("", 0)
    except ValueError:  # damaged in a part that only this reads
        return _reason(error)
    known = {
        "here": f"onnxruntime {_onnxruntime().__version__}",
        "version": version,
        "opset": opset,
        "by": f" (written by {producer})" if producer else "",
    }
    for pattern, sentence in _CAUSES.items():
        if found := re.search(pattern, text):
            return sentence.format(*found.groups(), **known)
    return _reason(error)


_NEWER = "pip install -U onnxruntime, or export the model anew"
_WITHOUT = "export the model without it, such as without NMS inside"
_CAUSES: Mapping[str, str] = {
    r"max supported IR version: (\d+)": (
        f"it has IR version {{version}}{{by}}, and {{here}} reads up to {{0}}: {_NEWER} for that version"
    ),
    r"(?:till|up to|is) opset (\d+)": (
        f"it has opset {{opset}}{{by}}, and {{here}} knows up to {{0}}: {_NEWER} with opset_version={{0}}"
    ),
    r"\b(\w+_TRT)\b": (f"it needs the operator {{0}} of TensorRT, which {{here}} does not have: {_WITHOUT}"),
    r"([\w.]+):(\w+)\(-?\d+\) is not a registered function": (
        f"it needs the operator {{1}} of {{0}}, which {{here}} does not have: {_WITHOUT}"
    ),
    r"No opset import for domain '([^']*)'": (
        f"it needs operators of {{0}}, which {{here}} does not have: {_WITHOUT}"
    ),
    r"No Op registered for (\w+) with domain_version of (\d+)": (
        "opset {1} has no operator {0}{by}: export the model anew with a higher opset_version"
    ),
    r"Could not find an implementation for (\w+)\((\d+)\)": (
        "{here} has no {0} (opset {1}) for its type of numbers: export the model in float32"
    ),
}
"""Messages of onnxruntime, and our sentences in their place."""


def _reason(error: Exception) -> str:
    # The first line of onnxruntime's message without its code prefix and its files, at most 300 characters.
    lines = str(error).strip().splitlines()
    line = lines[0] if lines else type(error).__name__
    line = re.sub(r"^(\[ONNXRuntimeError\] : \d+ : \w+ : )?(/\S+:\d+ .*?\) )?", "", line)
    return line if len(line) <= _MOST_CHARS else line[:_MOST_CHARS].rpartition(" ")[0] + " …"
