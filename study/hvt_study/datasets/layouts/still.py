"""Annotated aerial pictures, made into sequences by a virtual camera that flies over them.

VisDrone-DET's layout (ROOT/images/NAME.jpg, ROOT/annotations/NAME.txt), YOLO's (ROOT/labels/NAME.txt and
ROOT/classes.txt), a folder of pictures with NAME.txt beside NAME.jpg, or a single picture. Real pixels and real
labels, and boxes that follow exactly; the way is drawn from a seed. See `hvt_study.datasets.virtual_camera`.
"""

import logging
from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache, partial
from pathlib import Path

from hvt_common.errors import UserError
from hvt_edge.source.folder import left_out, sequence_files
from hvt_study.datasets.label_files import Folders, in_any_case
from hvt_study.datasets.label_table import file_stamp
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.image_sequence import find_folders
from hvt_study.datasets.layouts.options import Options
from hvt_study.datasets.sequence import NOMINAL_FPS, Clip, Sequence
from hvt_study.datasets.virtual_camera import SCHEME, USUAL_VIEW, VirtualCamera, annotation_file

_log = logging.getLogger(__name__)


def still_labels(
    picture: Path, file: Path, view: float, seed: int, classes: tuple[str, ...], index: int
) -> FrameLabels:
    """The virtual camera's labels in frame ``index``, in its pixels; each mirror image is an object of its own."""
    labels = _camera(picture, file, view, seed, classes, _stamps(picture, file)).labels(index)
    assert labels is not None, "made for annotated pictures only"
    return labels


def open_stills(place: Path, options: Options) -> Mapping[str, Callable[[], Sequence]]:
    """A sequence for each picture and seed by name, opened when called.

    Raises `UserError` where there are no pictures, or annotations are missing.
    """
    pictures = [place] if place.is_file() else _pictures(place)
    folders = Folders()
    if options.annotated and place.is_dir():
        _check_annotated(place, pictures, folders)
    return {
        name: partial(_open, name, picture, seed, options, folders)
        for label, picture in _labelled(pictures).items()
        for seed in options.seeds
        for name in [label if options.seeds == (0,) else f"{label}-{seed}"]
    }


def _pictures(place: Path) -> list[Path]:
    inner = (in_any_case(folder / "images") for folder in find_folders(place, depth=1))
    folders = [one for one in inner if one.is_dir()]
    found = [file for folder in folders or [place] for file in sequence_files(folder)]
    if not found:
        raise UserError(
            f"still folder {place} holds no pictures: expected are images/NAME.jpg and annotations/NAME.txt or "
            "labels/NAME.txt, or NAME.jpg and NAME.txt beside it"
        )
    if said := left_out({file.parent for file in found}, found, pictures=True):
        _log.warning("%s: %s", place, said)
    return found


def _labelled(pictures: list[Path]) -> dict[str, Path]:
    """Pictures by a name of their own."""
    found: dict[str, Path] = {}
    for picture in pictures:
        words = (picture.stem, picture.name, f"{picture.parent.parent.name}/{picture.name}", str(picture))
        found[next(word for word in words if word not in found)] = picture
    return found


def _check_annotated(place: Path, pictures: list[Path], folders: Folders) -> None:
    missing = next((one for one in pictures if not annotation_file(one, folders).is_file()), None)
    if missing is not None:
        raise UserError(
            f"still folder {place} has no annotations {annotation_file(missing, folders)} of picture {missing.name}: "
            "add them, or ask for pictures alone with ?labels=none"
        )


def _open(name: str, picture: Path, seed: int, options: Options, folders: Folders) -> Sequence:
    view = float(f"{options.view or USUAL_VIEW:g}")  # as it is written in the clip's name
    file = annotation_file(picture, folders)
    labelled = file if options.annotated else None
    camera = _camera(picture, labelled, view, seed, options.classes, _stamps(picture, file))
    known = camera.annotations
    named = () if known is None else known.class_names  # in the order of the file, which has but numbers
    return Sequence(
        name=name,
        dataset="still",
        clip=Clip(f"{SCHEME}{picture}@{view:g}", camera.size, camera.frame_count, seed=seed),
        frame_count=camera.frame_count,
        fps=NOMINAL_FPS,
        source_size=camera.size,
        labels=None if known is None else partial(still_labels, picture, file, view, seed, options.classes),
        class_set=camera.class_set,
        attributes={"view": f"{view:g}", "seed": f"{seed}", "classes": ",".join(dict.fromkeys(named))},
        files=(picture,) if known is None else (picture, file),
    )


@lru_cache(maxsize=2)
def _camera(
    picture: Path,
    file: Path | None,
    view: float,
    seed: int,
    classes: tuple[str, ...],
    stamps: tuple[Hashable, ...],  # noqa: ARG001 - part of the key
) -> VirtualCamera:
    return VirtualCamera(picture, view, NOMINAL_FPS, seed, file, classes)


def _stamps(picture: Path, file: Path) -> tuple[Hashable, ...]:
    """Other ones when picture or annotations have changed."""
    return file_stamp(picture), file_stamp(file)
