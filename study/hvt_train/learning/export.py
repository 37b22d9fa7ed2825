"""ONNX files of networks: go on from one, its batch norms measured anew, and write one that can be judged."""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn

from hvt_common.files import write_whole
from hvt_train.learning.detector import Added, DetectorNet
from hvt_train.learning.halve import halve, unfolded


def load_onnx(net: nn.Module, path: Path, images: Tensor, *, rows: Sequence[int] | None = None) -> None:
    """Put the weights of ``path`` into ``net``, which then computes the same and can be trained further.

    ``rows`` names for each class of a `DetectorNet` the class of the file that it begins as, -1 for none; without it
    the file has the same classes.

    The file's convolutions have absorbed their batch norms, so that a norm's mean and variance are measured on
    ``images`` ((N, 3, H, W) float32 BGR 0…255), and scale and shift are set to undo them.

    Blocks that YOLOX-nano lacks keep their first values where the file lacks them too.

    Raises `ValueError` where the file is of another architecture.
    """
    weights = _weights(onnx.load(str(path)).graph)
    hooks, order = [], iter(weights)

    def take(layer: nn.Module, _inputs: object) -> None:
        weight, bias = next(order, (np.zeros(0), np.zeros(0)))
        assert isinstance(layer, (nn.Conv2d, nn.Linear))
        if rows is not None and layer in named:
            weight, bias = _chosen(layer, weight, bias, rows)
        wanted = tuple(layer.weight.shape)
        if weight.shape != wanted:
            raise ValueError(f"{path} has weights {weight.shape} where {wanted} are expected")
        layer.weight.data = torch.from_numpy(weight.copy())
        pending.append(torch.from_numpy(bias.copy()))
        if layer.bias is not None:
            layer.bias.data = pending.pop()

    def measure(norm: nn.Module, inputs: tuple[Tensor]) -> None:
        assert isinstance(norm, nn.BatchNorm2d)
        assert norm.running_mean is not None
        assert norm.running_var is not None
        mean, variance = inputs[0].mean((0, 2, 3)), inputs[0].var((0, 2, 3))
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
        norm.weight.data = (variance + norm.eps).sqrt()
        norm.bias.data = pending.pop() + mean

    pending: list[Tensor] = []
    named = [head.classes for head in net.heads] if isinstance(net, DetectorNet) else []
    for module in _loaded(net, len(weights)):
        if isinstance(module, (nn.Conv2d, nn.Linear)):
            hooks.append(module.register_forward_pre_hook(take))
        elif isinstance(module, nn.BatchNorm2d):
            hooks.append(module.register_forward_pre_hook(measure))
    with torch.no_grad():
        net.eval()(images)
    for hook in hooks:
        hook.remove()


def _loaded(net: nn.Module, layers: int) -> list[nn.Module]:
    """The modules that a file of so many layers has weights for: all (joined ones come behind), or YOLOX-nano's."""
    modules = list(net.modules())
    if sum(isinstance(module, (nn.Conv2d, nn.Linear)) for module in modules) <= layers:
        return modules
    own = {part for one in modules if isinstance(one, Added) for part in one.modules()}
    return [module for module in modules if module not in own]


def _chosen(
    layer: nn.Conv2d | nn.Linear, weight: np.ndarray, bias: np.ndarray, rows: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """The file's rows in the order of ours; a class that the file lacks keeps its first values."""
    assert layer.bias is not None
    own_weight, own_bias = layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()
    for row, theirs in enumerate(rows):
        if theirs >= 0:
            own_weight[row], own_bias[row] = weight[theirs], bias[theirs]
    return own_weight, own_bias


def _weights(graph: onnx.GraphProto) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weight and bias of each layer, as float32, in the order of the file, which computes some in several stripes."""
    values = {item.name: numpy_helper.to_array(item).astype(np.float32) for item in graph.initializer}
    for node in graph.node:
        if node.op_type == "Cast" and node.input[0] in values:
            values[node.output[0]] = values[node.input[0]]
    for name, value in values.items():
        if value.shape[1:] == (12, 3, 3):
            values[name] = unfolded(value)
    layers = (tuple(node.input[1:3]) for node in graph.node if node.op_type in {"Conv", "Gemm"})
    return [(values[weight], values[bias]) for weight, bias in dict.fromkeys(layers)]


_OPSET = 17


def metadata(
    *, name: str, classes: Sequence[str], seed: int, commit: str, date: str, summary: str, **more: str
) -> dict[str, str]:
    """The metadata of both files; `hvt_common.inference.labels` reads ``names``."""
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
    """Write the network, whole or not at all; weights are stored as float16 and widened when the file is opened.

    Its input is called ``images`` and its output ``output``; ``free`` names the free axes of both.
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
    write_whole(path, model.SerializeToString())
