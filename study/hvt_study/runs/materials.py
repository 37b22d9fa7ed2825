"""What the runs over one sequence are made from, and what names their results; no picture is looked at here.

A study that is started again asks for little more than this: what it finds in its cache needs no pictures.
"""

from __future__ import annotations

import platform
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import av

from hvt_common import __version__
from hvt_common.errors import UserError
from hvt_common.inference.classify import Classifier, open_classifier
from hvt_common.inference.labels import default_confidence, first_synonym
from hvt_common.inference.store import MOTION, resolve_model
from hvt_common.tracking.bytetrack import weak_confidence
from hvt_ground.config import DETECTOR, NONE
from hvt_study.cache.cached_detector import CachedDetector
from hvt_study.cache.code_digest import flight_code
from hvt_study.cache.results import file_digest
from hvt_study.datasets.class_map import ClassMap, joint_classes
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.datasets.sequence import Sequence, content_hash
from hvt_study.runs.spec import ModelChoice, RunSpec

_PACKAGES = (
    *("numpy", "scipy", "opencv-python-headless", "av", "pillow", "pillow-jxl-plugin", "msgpack"),
    *("onnxruntime", "onnxruntime-gpu", "openvino"),
    *("faster-coco-eval", "motmetrics", "scikit-learn"),
)
"""Those that may change a result, as far as they are installed."""
_SEQUENCES = 8


@dataclass(frozen=True, slots=True)
class Materials:
    """Of one sequence, with the networks of its runs."""

    sequence: Sequence
    """As far as it is played, with the labels of its dataset."""
    classes: ClassMap
    """Between the ground's models and the labels."""
    detector: CachedDetector
    """The ground's."""
    edge_detector: CachedDetector
    classifier: Classifier | None
    """Reads the stills; None where the detector does, or nobody."""
    content: dict[str, str]
    """Hashes of all that the runs are made from."""
    software: dict[str, str]
    """All that has a say beside that, by name; what runs the networks too."""


def open_materials(spec: RunSpec, *, cache: Path) -> Materials:
    """What this run is made from; what several runs share is opened once.

    Raises:
        UserError: the dataset or a model cannot be used, there are no labels, or they do not map.
    """
    sequence, digest = _sequence(spec.dataset, spec.sequence)
    if spec.labels == "annotations" and sequence.labels is None:
        raise UserError(
            f"{spec.dataset} {spec.sequence} has no annotations: give a dataset that has, or --labels reference"
        )
    memory = cache / "detections"
    detector = _detector("ground", spec.models.detector, spec.models.provider, memory)
    classifier = _classifier(spec.models.classifier, spec.models.provider)
    read = None if classifier is None else classifier.class_names
    own = spec.labels == "reference"
    class_set = tuple(map(first_synonym, read or detector.class_names)) if own else sequence.class_set
    return Materials(
        sequence=sequence.limited(spec.max_frames),
        classes=joint_classes(detector.class_names, read, class_set),
        detector=detector,
        edge_detector=_detector("edge", spec.models.edge_detector, spec.models.provider, memory),
        classifier=classifier,
        content={"clip": digest, **_model_digests(spec.models)},
        software={**software_versions(), "provider": detector.model.provider.provider},
    )


@lru_cache(maxsize=1)
def software_versions() -> dict[str, str]:
    """Of everything that may change a result; of HVT's own code what is in its files, edited or not."""
    versions = {"hvt": __version__, "code": flight_code(), "python": platform.python_version()}
    versions |= {"machine": platform.machine()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return {**versions, "libav": _libav()}


def _libav() -> str:
    return " ".join(f"{name} {'.'.join(map(str, one))}" for name, one in sorted(av.library_versions.items()))


@lru_cache(maxsize=_SEQUENCES)
def _sequence(dataset: str, name: str) -> tuple[Sequence, str]:
    """The sequence and its hash: a process reads the files once."""
    (sequence,) = open_dataset(dataset, only=(_literal(name),))
    try:
        return sequence, content_hash(sequence)
    except OSError as error:
        raise UserError(
            f"dataset {dataset!r}: {name} cannot be read ({error}): mend it, or leave it out"
        ) from None


def _literal(name: str) -> str:
    """A pattern that this name alone fits."""
    return "".join(f"[{sign}]" if sign in "*?[" else sign for sign in name)


@lru_cache(maxsize=4)
def _detector(side: str, spec: str, provider: str, memory: Path) -> CachedDetector:
    """Each side has one of its own, whose CPU is its account; they share what is remembered."""
    if spec == MOTION:
        raise UserError(f"{MOTION!r} as detector of the {side} remembers pictures: give a detection network")
    confidence = weak_confidence(default_confidence(spec))
    return CachedDetector(spec, confidence=confidence, provider=provider, folder=memory)


@lru_cache(maxsize=4)
def _classifier(spec: str, provider: str) -> Classifier | None:
    return None if spec in (DETECTOR, NONE) else open_classifier(spec, threads=1, provider=provider)


@lru_cache(maxsize=4)
def _model_digests(models: ModelChoice) -> dict[str, str]:
    named = {"detector": models.detector, "edge_detector": models.edge_detector}
    if models.classifier not in (DETECTOR, NONE):
        named["classifier"] = models.classifier
    return {
        role: file_digest(resolve_model(one, role="classifier" if role == "classifier" else "detector"))
        for role, one in named.items()
    }
