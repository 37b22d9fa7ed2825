"""OpenVINO on the processor: the only file that imports openvino.

OpenVINO is a runtime of its own beside onnxruntime (the package onnxruntime-openvino would overwrite onnxruntime's
files). It reads the same ONNX file. With the precision hint bf16 the processor's bf16 instructions do the
convolutions and products; the steps after the last of them, such as the decoding of boxes, stay float32.
A model's files are checked without any library before OpenVINO parses them.
"""

from __future__ import annotations

import functools
import importlib.util
import logging
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError, absent, telling
from hvt_common.files import read_text
from hvt_common.inference.runtimes.model import ModelSettings, OnnxModel, Port, check_ports
from hvt_common.inference.runtimes.model_file import MAX_MODEL_BYTES, ULTRALYTICS, files_of
from hvt_common.inference.runtimes.providers import OpenVinoCpu, ProviderChoice
from hvt_common.runtime.statistics import Newest

_MAX_XML_BYTES = 64 << 20
_FIRST_BYTES = 512


def check_ir_file(path: Path) -> None:
    """Raise `UserError` in one sentence if it is certainly no IR, or not a whole one."""
    if not path.is_file():
        state = "is not a file" if path.exists() else "does not exist"
        raise absent(path)(f"model {path} {state}; an OpenVINO .xml with its .bin is expected")
    weights = files_of(path)[1]
    if not weights.is_file():
        raise UserError(f"model {path} has no {weights.name} beside it; OpenVINO keeps the weights there")
    for part, most in ((path, _MAX_XML_BYTES), (weights, MAX_MODEL_BYTES)):
        if part.stat().st_size > most:
            raise UserError(f"model {part} has {part.stat().st_size} bytes; at most {most} are accepted")
    with telling(f"model {path} cannot be read (", "): give an .xml of OpenVINO"), path.open("rb") as file:
        begin = file.read(_FIRST_BYTES)
    if b"<net" not in begin or b"<!DOCTYPE" in begin or b"<!ENTITY" in begin:
        raise UserError(f"model {path} is not an OpenVINO model (it begins with no <net>)")


def ir_metadata(path: Path) -> dict[str, str]:
    """The ``model_info`` of an IR and its ONNX file's metadata, by ONNX's names: ``names`` of the classes and so on.

    ``mean_values``, ``scale_values`` and ``reverse_input_channels``, of BGR pixels, become ``hvt.mean`` and so on.
    Ultralytics writes its own into ``metadata.yaml`` beside the file: its plain values and names are read too. Raises
    `UserError` as `check_ir_file` does.
    """
    check_ir_file(path)
    try:
        root = ET.parse(path).getroot()  # noqa: S314 - checked: no entities
    except (ET.ParseError, OSError) as error:
        raise UserError(f"model {path} is not an OpenVINO model, or is cut short ({error})") from error
    places = ("framework", "model_info")  # the first holds the metadata of the ONNX file that it was made of
    said = {one.tag: one.get("value", "") for place in places for one in root.iterfind(f"rt_info/{place}/*")}
    metadata = _yaml_of_ultralytics(path.with_name(ULTRALYTICS))
    found = (root.find(f"{place}/reverse_input_channels") for place in _OF_CONVERSION)
    turned = any(one is not None and one.get("value", "").lower() in _YES for one in found)
    # It is no step of the graph, but in its first weights.
    order = {"hvt.channel_order": "BGR"} if turned else {}
    labels = said.pop("labels", "").split()
    if labels and "names" not in metadata:
        metadata["names"] = repr([label.replace("_", " ") for label in labels])
    return order | _pixels_of_model_info(said) | said | metadata


_YES = ("yes", "true", "1")
_OF_CONVERSION = ("rt_info/conversion_parameters", "rt_info/cli_parameters", "meta_data/cli_parameters")
"""The parameters of OpenVINO's converter."""


def _pixels_of_model_info(said: Mapping[str, str]) -> dict[str, str]:
    found: dict[str, str] = {}
    if said.get("embedded_processing", "").lower() in _YES:  # they are steps of the graph
        return found
    mean, divisors = (said.get(key, "").strip("[]() ") for key in ("mean_values", "scale_values"))
    if mean or divisors:
        found["hvt.mean"] = mean or "0"
        with suppress(ValueError, ZeroDivisionError):  # text that is no number is refused later
            divisors = " ".join(str(1 / float(one)) for one in (divisors or "1").replace(",", " ").split())
        found["hvt.scale"] = divisors
    if "reverse_input_channels" in said:
        turned = said["reverse_input_channels"].lower() in _YES
        found["hvt.channel_order"] = "RGB" if turned else "BGR"
    return found


def _yaml_of_ultralytics(path: Path) -> dict[str, str]:
    # Plain keys, and the table of names as a literal; empty where there is no such file.
    try:
        lines = read_text(path).splitlines()
    except OSError:
        return {}
    found: dict[str, str] = {}
    names: dict[int, str] = {}
    sides: list[str] = []
    table = ""
    for line in lines:
        key = re.match(r"([a-z0-9_]+):\s*(.*)", line)
        entry = re.match(r"\s+(\d+):\s*(.+)", line)
        if key is not None:
            table = key[1]
            if key[2]:
                found[table] = key[2].strip("'\"")
        elif entry is not None and table == "names":
            names[int(entry[1])] = entry[2].strip().strip("'\"")
        elif table == "imgsz" and line.strip().startswith("- "):
            sides.append(line.strip()[2:])
    if names:
        found["names"] = repr(names)
    if sides:
        found["imgsz"] = f"[{', '.join(sides)}]"
    return found


_log = logging.getLogger(__name__)

_MAX_SHAPES = 4
_TRIAL_SIDE = 256
_TRIALS = 5
_WORTH_SHARE = 0.8
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


def _open_ir(path: Path, settings: ModelSettings) -> OnnxModel:
    # An OpenVINO model, in float32 where the reference is requested.
    if settings.provider not in ("auto", "cpu", "openvino"):
        raise UserError(
            f"model {path} is OpenVINO's: --provider {settings.provider} cannot run it; openvino can"
        )
    metadata = ir_metadata(path)
    found = find_openvino()
    if found is None:
        raise UserError(
            f"model {path} is OpenVINO's, which is not installed here: pip install 'hvt[openvino]'"
        )
    bf16 = found.bf16 and settings.provider != "cpu"
    runner = OpenVinoRunner(path, threads=settings.threads, bf16=bf16)
    inputs, outputs = (tuple(Port(*port) for port in ports) for ports in runner.ports)
    why = f"OpenVINO {found.version} in {'bf16' if bf16 else 'float32'}: the file is OpenVINO's"
    choice = ProviderChoice("openvino", why, explicit=True)
    check_ports(path, inputs, outputs)
    _log.info("%s runs on openvino: %s", path.name, why)
    return OnnxModel(path, inputs, outputs, metadata=metadata, runner=runner, provider=choice)


def _quicker(openvino: OnnxModel, plain: OnnxModel) -> OnnxModel:
    # ``plain``, on cpu, where that is about as quick. No table tells: bf16 takes 2/3 of the time here, 3/2 there.
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
    # The time of each of some runs, after one that may compile.
    model.run(feed)
    for _ in range(_TRIALS):
        began_s = time.perf_counter()
        model.run(feed)
        yield time.perf_counter() - began_s


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

    find, metadata = staticmethod(find_openvino), staticmethod(ir_metadata)
    open_ir, quicker = staticmethod(_open_ir), staticmethod(_quicker)

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
