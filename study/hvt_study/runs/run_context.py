"""What all flights over one sequence share: its pictures and labels, the networks, and the words that both speak."""

from __future__ import annotations

import os
import weakref
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import cv2
from filelock import FileLock

from hvt_common.errors import UserError
from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector
from hvt_common.inference.tiles import tiled
from hvt_study.cache.results import CacheError, ResultCache, content_key
from hvt_study.datasets.class_map import ClassMap
from hvt_study.datasets.clip import Clip, stage_clip
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.reference import ReferenceLabels, reference_labels, with_labels
from hvt_study.datasets.sequence import Sequence
from hvt_study.runs.materials import Materials, open_materials
from hvt_study.runs.spec import RunSpec

_OPEN_FILES = Path("/proc/self/fd")


@dataclass(frozen=True, slots=True)
class RunContext:
    """Open for one process; flights take turns."""

    sequence: Sequence
    labels: tuple[FrameLabels, ...]
    """Of every frame, source pixels."""
    classes: ClassMap
    """Between the ground's models and the labels."""
    detector: Detector
    """The ground's."""
    edge_detector: Detector
    classifier: Classifier | None
    pictures: object
    """Keeps the pixels; they go with it."""
    content: dict[str, str]
    """Hashes of all that the runs are made from."""


def open_run_context(spec: RunSpec, *, cache: Path) -> RunContext:
    """The context of this run; the last one stays open, so that runs over one sequence open it once.

    Raises:
        UserError: the dataset, a model or their labels cannot be used.
    """
    anyone = replace(spec, method="", regime="", budget_bps=0, still_codec="", target=None, tune=())
    return _open(anyone, cache)


@lru_cache(maxsize=1)
def _open(spec: RunSpec, cache: Path) -> RunContext:
    cv2.setNumThreads(1)  # there are as many processes as cores to use
    found = open_materials(spec, cache=cache)
    clip, pictures = _staged(found.sequence.clip)
    sequence = replace(found.sequence, clip=clip)
    if spec.labels == "reference":
        sequence = _with_reference(sequence, found, cache, base_size=spec.size)
    truth = (sequence.labels_at(frame_index) for frame_index in range(sequence.clip_frames))
    return RunContext(
        sequence=sequence,
        labels=tuple(one for one in truth if one is not None),
        classes=found.classes,
        detector=found.detector,
        edge_detector=found.edge_detector,
        classifier=found.classifier,
        pictures=pictures,
        content=found.content,
    )


def _staged(clip: Clip) -> tuple[Clip, object]:
    """The clip with its pixels in a file, if there is room, and what keeps that file.

    Where the system allows it the file has no name any more: it is gone with the process, however that ends.
    """
    try:
        folder = TemporaryDirectory(prefix="hvt-study-")
    except OSError as error:
        where = gettempdir()
        raise UserError(
            f"{where} takes no files ({error.strerror}): make room, or name another with TMPDIR"
        ) from None
    staged = stage_clip(clip, folder=Path(folder.name))
    if staged.pixels is not None and not _OPEN_FILES.is_dir():
        return staged, folder
    pixels = None if staged.pixels is None else _OpenFile(staged.pixels)
    folder.cleanup()
    return (staged, None) if pixels is None else (replace(staged, pixels=pixels.path), pixels)


class _OpenFile:
    """A file that is there as long as this object is, whatever becomes of its name."""

    def __init__(self, path: Path) -> None:
        number = os.open(path, os.O_RDONLY)
        self.path = _OPEN_FILES / str(number)
        weakref.finalize(self, os.close, number)


def _with_reference(
    sequence: Sequence, found: Materials, cache: Path, *, base_size: tuple[int, int]
) -> Sequence:
    """The sequence in the words of the ground's models; processes that ask for the same wait for the first.

    Frames are looked at as they are, but never smaller than the ground sees them: of a clip that is smaller than the
    base stream the detector would find less in the source than in what the link delivers. And they are looked at in
    the tiles of ``--tiles auto``: without them the edge would find more in the source than the labels know, and what
    it finds would be called false.
    """
    smaller = any(side < base for side, base in zip(sequence.source_size, base_size, strict=True))
    size = base_size if smaller else None
    name = content_key("labels", "tiles", found.content, found.software, sequence.clip_frames, size)
    store = ResultCache(cache / "labels")

    def label() -> dict[str, Any]:
        detector = tiled(found.detector, "auto")
        return reference_labels(sequence, detector=detector, classifier=found.classifier, size=size).pack()

    try:
        with FileLock(cache / "labels" / f"{name}.lock"):
            known = store.known(name, label)
    except OSError as error:
        raise CacheError(
            f"cache {cache} cannot be used ({error.strerror}): name another with --cache"
        ) from None
    return with_labels(sequence, ReferenceLabels.unpack(known))
