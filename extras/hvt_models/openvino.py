"""OpenVINO on the processor: the only file that imports openvino.

OpenVINO is a runtime of its own beside onnxruntime (the package onnxruntime-openvino would overwrite onnxruntime's
files). It reads the same ONNX file. With the precision hint bf16 the processor's bf16 instructions do the
convolutions and products; the steps after the last of them, such as the decoding of boxes, stay float32.
"""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.runtimes.providers import OpenVinoCpu
from hvt_common.runtime.statistics import Newest

_MAX_SHAPES = 4
_Port = tuple[str, tuple[int | None, ...], np.dtype[Any] | None]


def find_openvino() -> OpenVinoCpu | None:
    """The OpenVINO that is installed with its processor plugin, if any; importing it takes 0.2 s."""
    if importlib.util.find_spec("openvino") is None:
        return None
    try:
        import openvino  # noqa: PLC0415  (optional)

        abilities = _core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    except (ImportError, RuntimeError):
        return None  # installed for another machine, or without the processor plugin
    version: str = openvino.__version__.partition("-")[0]
    return OpenVinoCpu(version=version, bf16="BF16" in abilities)


class OpenVinoRunner:
    """One ONNX file on the processor through OpenVINO, in bf16 or float32.

    A network is compiled for each image size (0.2 s; the last four are cached): with free sizes the same network
    takes a fifth longer. A free batch stays free, for batches come in every size. Raises `UserError` where OpenVINO
    cannot read the model.
    """

    def __init__(self, path: Path, *, threads: int, bf16: bool) -> None:
        self._path = path
        self._settings = {
            "INFERENCE_PRECISION_HINT": "bf16" if bf16 else "f32",
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": "1",
            "PERFORMANCE_HINT": "LATENCY",
            "ENABLE_CPU_PINNING": False,  # the encoder runs on the same cores
        }
        try:
            self._model = _core().read_model(path)
        except RuntimeError as error:
            raise UserError(f"model {path} cannot be read by openvino: {_reason(error)}") from error
        self.compiled: Newest[tuple[int, ...], Any] = Newest(_MAX_SHAPES)
        """By input shape without the batch."""

    find = staticmethod(find_openvino)

    @property
    def ports(self) -> tuple[list[_Port], list[_Port]]:
        """Inputs and outputs as the file declares them: name, shape with None where free, dtype."""
        return [_port(one) for one in self._model.inputs], [_port(one) for one in self._model.outputs]

    def run(self, feed: npt.NDArray[Any], *more: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Run on the inputs; the outputs in their declared order, tensors of their own.

        Raises `UserError` where OpenVINO cannot run this model on an input of this shape.
        """
        try:
            request = self._request(feed.shape)
            feeds = {index: np.ascontiguousarray(one) for index, one in enumerate((feed, *more))}
            results = request.infer(feeds, share_inputs=True)
            return [np.asarray(results[index]) for index in range(len(results))]
        except RuntimeError as error:
            shape = "x".join(map(str, feed.shape))
            raise UserError(
                f"model {self._path} does not run on a {shape} input with openvino: {_reason(error)}"
                " (--provider cpu may)"
            ) from error

    def _request(self, shape: tuple[int, ...]) -> Any:
        key = shape[1:]
        if key not in self.compiled:
            model = self._model.clone()
            batch = self._model.input(0).get_partial_shape()[0]
            model.reshape({0: [batch.get_length() if batch.is_static else -1, *key]})
            self.compiled[key] = _core().compile_model(model, "CPU", self._settings).create_infer_request()
        self.compiled.move_to_end(key)
        return self.compiled[key]


@functools.cache
def _core() -> Any:
    # One for the whole process: its processor plugin gives the thread that loads it a stack for signals, and takes
    # that back when it goes. Where another thread let it go, Ctrl-C would be handled on memory that is gone, and end
    # the program without a word.
    import openvino  # noqa: PLC0415  (optional)

    return openvino.Core()


def _port(value: Any) -> _Port:
    shape = tuple(side.get_length() if side.is_static else None for side in value.get_partial_shape())
    try:
        dtype = np.dtype(value.element_type.to_dtype())
    except (RuntimeError, TypeError):  # a type that numpy does not have
        dtype = None
    return min(value.names, default=value.node.friendly_name), shape, dtype


def _reason(error: Exception) -> str:
    # Unknown operators stand behind two dashes; of other messages the last line is the most telling.
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    telling = [line.removeprefix("-- ") for line in lines if line.startswith("-- ")] or lines[-1:]
    return telling[0][:200]
