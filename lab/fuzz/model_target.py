"""Model files: the walk before the runtime, and the runtime."""

import contextlib

import numpy as np

from hvt_common.errors import UserError
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from lab.fuzz.contract import Target, scratch
from media.onnx_models import colour_classifier, constant_model


def _model(data: bytes) -> None:
    path = scratch() / "m.onnx"
    path.write_bytes(data)
    with contextlib.suppress(UserError):
        open_model(path, settings=ModelSettings(threads=1))


def _seeds() -> list[bytes]:
    small = constant_model(scratch() / "seed.onnx", np.ones((1, 2), np.float32), metadata={"names": "['a']"})
    return [small.read_bytes(), colour_classifier(scratch() / "seed.onnx").read_bytes()]


TARGETS = (Target("model-file", _model, _seeds, share=8, short=200, most_bytes=2000),)
