"""ONNX models, on onnxruntime or another runtime: the only file that imports onnxruntime.

A model file comes from outside: `onnx_file` checks it first, and what it declares has bounds. It is read as ONNX
whatever its name ends in, and no custom operator library is registered. A model that another runtime will run is
opened by onnxruntime first: that gives ports and metadata, and no runtime gets a file that onnxruntime refuses.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from hvt_common.errors import UserError
from hvt_common.inference.runtimes.onnx_file import check_onnx_file
from hvt_common.inference.runtimes.openvino_model import OpenVinoRunner, find_openvino
from hvt_common.inference.runtimes.providers import ONNXRUNTIME_PROVIDERS, ProviderChoice, choose_provider
from hvt_common.runtime.process import NETWORK_NICENESS, lower_priority

__all__ = ["ModelSettings", "OnnxModel", "Port", "open_model"]

_T = TypeVar("_T")

_log = logging.getLogger(__name__)

_MOST_PORTS = 64
_MOST_AXES = 8
_MOST_ELEMENTS = 1 << 26
"""Of one input or output with its free sizes taken as 1: 256 MiB of float32, a picture of 4096x4096 and more."""

_TRIAL_SIDE = 256
_TRIALS = 5
_WORTH_SHARE = 0.8

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


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """How a model is run."""

    threads: int = 1
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

        Raises `UserError` where this model cannot run on an input of this shape.
        """
        port = self.inputs[0]
        if len(feed.shape) != len(port.shape) or any(
            size not in (None, given) for size, given in zip(port.shape, feed.shape, strict=True)
        ):
            shape = "x".join(map(str, feed.shape))
            raise UserError(f"model {self.path} does not run on a {shape} input: it takes {port}")
        return self._runner.run(feed)


class _Background:
    """A thread of the lowest priority that opens and runs one network, and whose workers have that priority too.

    Whoever waits for the answer keeps its own: what it computes with the interpreter's lock held may hold up video.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(
            1, thread_name_prefix="hvt-network", initializer=partial(lower_priority, NETWORK_NICENESS)
        )

    def do(self, call: Callable[[], _T]) -> _T:
        return self._thread.submit(call).result()


@dataclass(frozen=True, slots=True)
class _InBackground:
    """Another runner, there."""

    background: _Background
    runner: _Runner

    def run(self, feed: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        return self.background.do(lambda: self.runner.run(feed))


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

    Raises `UserError` where there is no such file, or it is too large, no ONNX model or one that the runtime
    cannot load; or for a provider that is unknown, not installed or cannot start.
    """
    settings = settings or ModelSettings()
    choice = choose_provider(
        settings.provider, onnxruntime=ort.get_available_providers(), openvino=find_openvino
    )
    check_onnx_file(path)
    try:
        model = _open(path, settings, choice)
        if choice.provider == "openvino" and not choice.explicit:
            model = _quicker(model, path, settings)
    except UserError as error:
        if choice.explicit or choice.provider == "cpu":
            raise
        model = _open(path, settings, ProviderChoice("cpu", str(error), explicit=False))
    except UnicodeDecodeError as error:  # a name in the file, or the runtime's message that quotes it
        raise UserError(f"model {path} cannot be opened: a name in it is not text") from error
    _log.info("%s runs on %s: %s", path.name, model.provider.provider, model.provider.why)
    return model


def _quicker(openvino: OnnxModel, path: Path, settings: ModelSettings) -> OnnxModel:
    """The model on OpenVINO, or on cpu where that is about as quick: its numbers are the finer ones.

    No table could tell: the same network in bf16 takes two thirds of the time on one processor, half as much again on
    another.
    """
    plain = _open(path, settings, ProviderChoice("cpu", "", explicit=False))
    shape = [
        size or free
        for size, free in zip(plain.inputs[0].shape, (1, 3, _TRIAL_SIDE, _TRIAL_SIDE), strict=False)
    ]
    feed = np.zeros(shape, plain.inputs[0].dtype or np.float32)
    share = min(_seconds(openvino, feed)) / min(_seconds(plain, feed))
    version = openvino.provider.why.partition(" is installed")[0]
    if share < _WORTH_SHARE:
        why = f"{version} in bf16 takes {share:.0%} of onnxruntime's time here"
        openvino.provider = replace(openvino.provider, why=why)
        return openvino
    plain.provider = replace(plain.provider, why=f"{version} takes {share:.0%} of its time here")
    return plain


def _seconds(model: OnnxModel, feed: npt.NDArray[Any]) -> Iterator[float]:
    """The time of each of some runs, after one that may compile."""
    model.run(feed)
    for _ in range(_TRIALS):
        began_s = time.perf_counter()
        model.run(feed)
        yield time.perf_counter() - began_s


def _open(path: Path, settings: ModelSettings, choice: ProviderChoice) -> OnnxModel:
    background = _Background()
    if choice.provider == "openvino":
        described = _session(path, settings, ("CPUExecutionProvider",), optimised=False)
        found = find_openvino()
        bf16 = found is not None and found.bf16
        openvino = background.do(lambda: OpenVinoRunner(path, threads=settings.threads, bf16=bf16))
        return OnnxModel(path, described, runner=_InBackground(background, openvino), provider=choice)
    names = ONNXRUNTIME_PROVIDERS[choice.provider]
    session = background.do(lambda: _session(path, settings, names))
    if session.get_providers()[0] != names[0]:
        raise UserError(
            f"--provider {choice.provider} did not start (its driver or libraries are missing): choose cpu"
        )
    runner = _InBackground(background, _OnnxRuntimeRunner(path, session))
    return OnnxModel(path, session, runner=runner, provider=choice)


def _session(
    path: Path, settings: ModelSettings, providers: tuple[str, ...], *, optimised: bool = True
) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = settings.threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # A plan of all tensors for each input shape takes 35 MB more than an arena that reuses them, and saves no time.
    options.enable_mem_pattern = False
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
    """Refuse a model whose ports are out of bounds."""
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
