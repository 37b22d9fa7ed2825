"""The inputs of the runs over one sequence, the names of their results, and the parts that all flights share.

A study that is started again asks for little more than its `Materials`, for which no picture is read: cached results
need none.
"""

import logging
import os
import platform
import tempfile
import weakref
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import av
import cv2

from hvt_common import __version__
from hvt_common.errors import UserError
from hvt_common.files import locked
from hvt_common.inference.classify import Classifier, open_classifier
from hvt_common.inference.detect import Detector
from hvt_common.inference.labels import default_confidence, first_synonym
from hvt_common.inference.runtimes.model_file import files_of
from hvt_common.inference.store import MOTION, resolve_model
from hvt_common.inference.tiles import tiled
from hvt_common.tracking.settings import weak_confidence
from hvt_ground.config import DETECTOR, NONE
from hvt_study.cache.results import (
    CachedDetector,
    CacheError,
    ResultCache,
    content_key,
    digest_of_file,
    file_digest,
    flight_code,
    installed,
)
from hvt_study.datasets.class_map import ClassMap, joint_classes
from hvt_study.datasets.label_table import file_stamp
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.datasets.reference import ReferenceLabels, reference_labels, with_labels
from hvt_study.datasets.sequence import Clip, Sequence, content_hash, stage_clip
from hvt_study.runs.spec import ModelChoice, RunSpec

_log = logging.getLogger(__name__)

_PACKAGES = (
    *("numpy", "scipy", "opencv-python-headless", "av", "pillow", "pillow-jxl-plugin", "msgpack"),
    *("onnxruntime", "onnxruntime-gpu", "openvino"),
    *("faster-coco-eval", "motmetrics", "scikit-learn"),
)
"""Those that may change a result, as far as they are installed."""
_SEQUENCES = 8


@dataclass(frozen=True, slots=True)
class Materials:
    """Materials of one sequence, with the networks of its runs."""

    sequence: Sequence
    """As far as it is played, with the labels of its dataset."""
    classes: ClassMap
    detector: Detector
    """The ground's."""
    edge_detector: Detector
    classifier: Classifier | None
    """Reads the stills; None where the detector does, or nobody."""
    content: dict[str, str]
    software: dict[str, str]
    """All other versions that matter, by name; the provider of the networks too."""


def open_materials(spec: RunSpec, *, cache: Path) -> Materials:
    """The inputs of this run; inputs that several runs share are opened once.

    Raises `UserError` where the dataset or a model cannot be used, there are no labels, or they do not map.
    """
    _forget_if_changed(spec)
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
        content={"clip": digest, **model_digests(spec.models)},
        software={**software_versions(), "provider": detector.model.provider.provider},
    )


@lru_cache(maxsize=1)
def software_versions() -> dict[str, str]:
    """Versions of everything that may change a result; HVT's own code counts by its files, edited or not."""
    versions = {"hvt": __version__, "code": flight_code(), "python": platform.python_version()}
    libav = (f"{name} {'.'.join(map(str, one))}" for name, one in sorted(av.library_versions.items()))
    return {**versions, "machine": platform.machine(), **installed(_PACKAGES), "libav": " ".join(libav)}


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
    return "".join(f"[{sign}]" if sign in "*?[" else sign for sign in name)


@lru_cache(maxsize=4)
def _detector(side: str, spec: str, provider: str, memory: Path) -> CachedDetector:
    """Each side has one of its own, with its own account of CPU; they share the memory."""
    if spec == MOTION:
        raise UserError(f"{MOTION!r} as detector of the {side} remembers pictures: give a detection network")
    confidence = weak_confidence(default_confidence(spec))
    return CachedDetector(spec, confidence=confidence, provider=provider, folder=memory)


@lru_cache(maxsize=4)
def _classifier(spec: str, provider: str) -> Classifier | None:
    return None if spec in (DETECTOR, NONE) else open_classifier(spec, threads=1, provider=provider)


@lru_cache(maxsize=4)
def model_digests(models: ModelChoice) -> dict[str, str]:
    """Digest of all files of each network, by its role; a process reads them once."""
    return {role: " ".join(map(file_digest, paths)) for role, paths in _model_files(models).items()}


@lru_cache(maxsize=4)
def _model_files(models: ModelChoice) -> dict[str, tuple[Path, ...]]:
    named = {"detector": models.detector, "edge_detector": models.edge_detector}
    if models.classifier not in (DETECTOR, NONE):
        named["classifier"] = models.classifier
    resolved = {role: resolve_model(one, role=role.removeprefix("edge_")) for role, one in named.items()}
    return {role: tuple(files_of(path)) for role, path in resolved.items()}


@lru_cache(maxsize=1)
def begin_study(study: str) -> None:  # noqa: ARG001 - another one is another call
    """Forget all that is open for another study: Dask workers live on while labels are mended, models trained."""
    _forget()


def _forget() -> None:
    known = (
        _sequence,
        _detector,
        _classifier,
        model_digests,
        _model_files,
        _open,
        digest_of_file,
        _first_stamp,
    )
    for one in known:
        one.cache_clear()


@cache
def _first_stamp(path: Path) -> tuple[int, int]:
    return file_stamp(path)


def _forget_if_changed(spec: RunSpec) -> None:
    # Else a result of old weights, still open, would be kept under the name of new ones, or the reverse.
    sequence, _ = _sequence(spec.dataset, spec.sequence)
    paths = (*(path for paths in _model_files(spec.models).values() for path in paths), *sequence.files)
    changed = next((path for path in paths if file_stamp(path) != _first_stamp(path)), None)
    if changed is not None:
        _log.warning(
            "%s was written while the study runs: runs from here on are of what it holds now", changed
        )
        _forget()
        for path in paths:  # at once, so that a later write is noticed too
            _first_stamp(path)


_OPEN_FILES = Path("/proc/self/fd")


@dataclass(frozen=True, slots=True)
class RunContext(Materials):
    """Open for one process; flights take turns. Its sequence has the labels of the runs, and its pixels at hand."""

    labels: tuple[FrameLabels, ...]
    """Labels of every frame, source pixels."""
    pictures: object
    """Keeps the pixels; they go with it."""


def open_run_context(spec: RunSpec, *, cache: Path) -> RunContext:
    """The context of this run; the last one stays open, so that runs over one sequence open it once.

    Raises `UserError` where the dataset, a model or their labels cannot be used.
    """
    anyone = replace(spec, method="", regime="", budget_bps=0, still_codec="", target=None, tune=())
    return _open(anyone, cache)


@lru_cache(maxsize=1)
def _open(spec: RunSpec, cache: Path) -> RunContext:
    cv2.setNumThreads(1)  # there are as many processes as cores to use
    found = open_materials(spec, cache=cache)
    clip, pictures = open_pixels(found.sequence.clip)
    sequence = replace(found.sequence, clip=clip)
    if spec.labels == "reference":
        sequence = _with_reference(sequence, found, cache, base_size=spec.size)
    truth = (sequence.labels_at(frame_index) for frame_index in range(sequence.clip_frames))
    own = {one.name: getattr(found, one.name) for one in fields(found)} | {"sequence": sequence}
    return RunContext(**own, labels=tuple(one for one in truth if one is not None), pictures=pictures)


def open_pixels(clip: Clip) -> tuple[Clip, object]:
    """The clip with its pixels in a file, if there is room, and the owner of that file.

    Where the system allows it the file has no name from the first pixel on: it is gone with the process, whenever and
    however that ends.
    """
    try:
        keeper: object = (folder := tempfile.TemporaryDirectory(prefix="hvt-study-"))
        path = Path(folder.name) / "clip.bgr"
        if _OPEN_FILES.is_dir():
            keeper = (file := _OpenFile(path))
            folder.cleanup()
            path = file.path
    except OSError as error:
        where = tempfile.tempdir or "no folder for temporary files"  # None where each refuses
        raise UserError(
            f"{where} takes no files ({error.strerror}): make room, or name another with TMPDIR"
        ) from None
    staged = stage_clip(clip, path)
    return staged, None if staged.pixels is None else keeper


class _OpenFile:
    """A new file that is there as long as this object is, whatever becomes of its name."""

    def __init__(self, path: Path) -> None:
        number = os.open(path, os.O_RDWR | os.O_CREAT)
        self.path = _OPEN_FILES / str(number)
        weakref.finalize(self, os.close, number)


def _with_reference(
    sequence: Sequence, found: Materials, cache: Path, *, base_size: tuple[int, int]
) -> Sequence:
    """The sequence in the words of the ground's models; processes that ask for the same wait for the first.

    Frames are looked at as they are, but never smaller than the ground sees them: of a clip that is smaller than the
    base stream the detector would find less in the source than in the delivered video. And they are searched in the
    tiles of ``--tiles auto``: without them the edge would find more in the source than the labels know, and that
    would be called false.
    """
    smaller = any(side < base for side, base in zip(sequence.source_size, base_size, strict=True))
    size = base_size if smaller else None
    name = content_key("labels", "tiles", found.content, found.software, sequence.clip_frames, size)
    store = ResultCache(cache / "labels")

    def label() -> dict[str, Any]:
        detector = tiled(found.detector, "auto")
        return reference_labels(sequence, detector=detector, classifier=found.classifier, size=size).pack()

    try:
        with locked(cache / "labels" / f"{name}.lock"):
            known = store.known(name, label)
    except OSError as error:
        raise CacheError(
            f"cache {cache} cannot be used ({error.strerror}): name another with --cache"
        ) from None
    return with_labels(sequence, ReferenceLabels.unpack(known))
