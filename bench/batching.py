"""Whether a detector takes several pictures at once faster than one after the other: `python -m bench batching`.

Both in turn on the same pictures, 640x384 as of an edge of 640x360; the median of the ratios of neighbours is shown.
The model takes one picture; of a copy the batch is freed. The embedded detector, two networks in one file, is not
measured: the sizes inside it are of one picture.
"""

import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper

from bench.bars import measured
from bench.support.material import nano
from hvt_common.inference.runtimes.model import ModelSettings, open_model

_SHAPE = (3, 384, 640)
_ROUNDS = 25


def rows() -> list[dict]:
    result = []
    with tempfile.TemporaryDirectory() as folder:
        freed = Path(folder) / nano().name
        onnx.save(_of_free_batch(nano()), str(freed))
        for threads in (1, 2):
            for count in (2, 4):
                ratio = _ratio(freed, threads=threads, count=count)
                of = f"{nano().stem}, {count} at once, {threads} threads"
                result.append(measured("pictures a second over one at a time", ratio, of=of))
    return result


def _ratio(path: Path, *, threads: int, count: int) -> float:
    model = open_model(path, settings=ModelSettings(threads=threads))
    pictures = np.random.default_rng(0).uniform(0, 255, (count, *_SHAPE)).astype(np.float32)
    single = [pictures[index : index + 1] for index in range(count)]
    together, apart = model.run(pictures)[0], np.concatenate([model.run(one)[0] for one in single])
    # Other sums in another order, of logits or of boxes in pixels.
    assert np.allclose(together, apart, rtol=1e-2, atol=0.5), "the freed batch computes something else"
    ratios = []
    for _ in range(_ROUNDS):
        began_s = time.perf_counter()
        for one in single:
            model.run(one)
        half_s = time.perf_counter()
        model.run(pictures)
        ratios.append((half_s - began_s) / (time.perf_counter() - half_s))
    return statistics.median(ratios)


def _of_free_batch(path: Path) -> onnx.ModelProto:
    model = onnx.load(str(path))
    for value in (*model.graph.input, *model.graph.output):
        value.type.tensor_type.shape.dim[0].dim_param = "batch"
    del model.graph.value_info[:]
    shapes = {node.input[1] for node in model.graph.node if node.op_type == "Reshape"}
    for tensor in model.graph.initializer:
        if tensor.name in shapes:
            tensor.CopyFrom(_with_free_batch(tensor))
    for node in model.graph.node:
        if node.op_type == "Constant" and node.output[0] in shapes:
            node.attribute[0].t.CopyFrom(_with_free_batch(node.attribute[0].t))
    return model


def _with_free_batch(shape: onnx.TensorProto) -> onnx.TensorProto:
    """For Reshape, 0 is the size that the input has."""
    sizes = numpy_helper.to_array(shape).copy()
    sizes[0] = 0
    return numpy_helper.from_array(sizes, shape.name)
