"""Reads the classes and the calibration of a model from its metadata, without opening a network."""

from __future__ import annotations

import math
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.inference.labels import metadata_labels
from hvt_common.inference.runtimes.ir_file import ir_metadata, is_ir
from hvt_common.inference.runtimes.onnx_file import onnx_metadata
from hvt_common.inference.runtimes.plug_in import plug_in_names, plug_in_of
from hvt_common.inference.store import MOTION, parts_of, resolve_model

USUAL_CONFIDENCE = 0.25
"""From where detections count, where neither the user nor the model says."""

_CONFIDENCE = "hvt.confidence"
_CALIBRATION = "hvt.calibration"
_LEAST_CONFIDENCE = 0.01


def declared_class_names(spec: str) -> tuple[str, ...] | None:
    """A detector's class names, where its file says them; None for others, motion, plug-ins and ensembles.

    Raises `UserError` where there is no such model.
    """
    if len(parts_of(spec)) > 1:
        return None
    return metadata_labels(_metadata(spec, role="detector"))


def default_confidence(spec: str) -> float:
    """From where a detector's detections start a track, 0.01…1: ``hvt.confidence`` of its metadata, else 0.25.

    ``spec`` is as of `open_detector`; of an ensemble the first counts. Raises `UserError` where there is no such
    model, or the metadata make no sense.
    """
    text = _metadata(parts_of(spec)[0], role="detector").get(_CONFIDENCE)
    if text is None:
        return USUAL_CONFIDENCE
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not _LEAST_CONFIDENCE <= value <= 1:
        raise UserError(
            f"model {spec} has {_CONFIDENCE} '{text:.80}' in its metadata; a number from {_LEAST_CONFIDENCE} to 1 is"
            " accepted"
        )
    return value


def is_calibrated(spec: str, *, role: str) -> bool:
    """Whether a model's scores were fitted to how often they are right: its metadata have ``hvt.calibration``.

    Those of the motion detector and of plug-ins are not; an ensemble's are where all its parts' are. Raises
    `UserError` where there is no such model.
    """
    parts = parts_of(spec) if role == "detector" else (spec,)
    return all(_CALIBRATION in _metadata(part, role=role) for part in parts)


def _metadata(spec: str, *, role: str) -> dict[str, str]:
    # The metadata of a file; the motion detector and plug-ins have none.
    if role == "detector" and (spec == MOTION or plug_in_of(spec) is not None):
        return {}
    path = resolve_model(spec, role=role, words=(MOTION, *plug_in_names()))
    return ir_metadata(path) if is_ir(path) else onnx_metadata(path)


def uncalibrated(role: str, spec: str) -> str:
    """The sentence, logged once, for a model whose scores are not calibrated."""
    plug_in = role == "detector" and plug_in_of(spec) is not None
    return (
        f"{role} {spec if plug_in else Path(spec).name} has no calibration ({_CALIBRATION} in its metadata):"
        " its scores are no probabilities"
    )
