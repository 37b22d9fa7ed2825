"""From a trained network to an ONNX file that carries what is needed to use and to judge it."""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import onnx
import torch
from onnx import helper
from torch import nn

from hvt_train.learning.halve import halve

_OPSET = 17


def metadata(
    *, name: str, classes: Sequence[str], seed: int, commit: str, date: str, summary: str, **more: str
) -> dict[str, str]:
    """What both files carry; ``names`` is read by `hvt_common.inference.labels`."""
    return {
        "names": str(dict(enumerate(classes))),
        "classes": json.dumps(list(classes)),
        "model": name,
        "description": summary,
        "license": "Apache-2.0",
        "hvt.training_commit": commit,
        "hvt.training_seed": str(seed),
        "hvt.training_date": date,
        **more,
    }


def export_onnx(
    net: nn.Module,
    path: Path,
    *,
    example: torch.Tensor,
    free: Mapping[str, Mapping[int, str]],
    properties: Mapping[str, str],
) -> None:
    """Write the network; weights are stored as float16 and widened when the file is opened.

    Args:
        net: in evaluation mode; its input is called ``images`` and its output ``output``.
        path: to write, whole or not at all.
        example: an input.
        free: names of the free axes of input and output.
        properties: the file's metadata.
    """
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # The older exporter writes the plainer graph and needs no further package; it says that it is the older one.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            net.eval().to(memory_format=torch.contiguous_format),
            (example,),
            buffer,
            input_names=["images"],
            output_names=["output"],
            dynamic_axes={name: dict(axes) for name, axes in free.items()},
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load_from_string(buffer.getvalue())
    halve(model.graph)
    helper.set_model_props(model, dict(properties))
    model.producer_name, model.producer_version = "hvt_train", ""
    onnx.checker.check_model(model)
    partial = path.with_suffix(".part")
    partial.write_bytes(model.SerializeToString())
    partial.replace(path)
