"""The models that come with the package: trained in this repository, Apache-2.0; see ``docs/models.md``."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from hvt_common.errors import UserError

__all__ = ["CLASSIFIER", "DETECTOR", "EMBEDDED_MODELS", "embedded_model"]

DETECTOR = "aerial-nano"
"""Finds vehicles and people seen from above or aslant; opened with `hvt_common.inference.detect.open_detector`."""
CLASSIFIER = "aerial-cls"
"""Says what a still shows; opened with `hvt_common.inference.classify.open_classifier`."""
EMBEDDED_MODELS = (DETECTOR, CLASSIFIER)


def embedded_model(name: str) -> Path:
    """The ONNX file of an embedded model.

    Raises:
        UserError: There is no embedded model of that name.
    """
    if name not in EMBEDDED_MODELS:
        raise UserError(f"embedded model '{name}' does not exist; {' and '.join(EMBEDDED_MODELS)} do")
    path = resources.files("hvt_common") / "models" / f"{name}.onnx"
    assert isinstance(path, Path), "the package is installed as files, not run from an archive"
    return path
