"""A sequence as a folder of numbered images, present and missing ones; and clips without labels."""

import logging
import re
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Words
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.units import exact_rate
from hvt_edge.source.contract import SourceSettings
from hvt_edge.source.folder import left_out, sequence_files
from hvt_edge.source.resample import base_frame_count
from hvt_edge.source.video import VideoSource
from hvt_study.datasets.label_files import read_image
from hvt_study.datasets.label_table import TableLabels
from hvt_study.datasets.layouts.options import Options
from hvt_study.datasets.sequence import NOMINAL_FPS, Clip, Sequence

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ImageSequence:
    """Images of one folder in the order of their numbers.

    Raises:
        UserError: there is none, one has no number, a number is missing or twice there, or the first is not an image.
    """

    folder: Path
    first_number: int = field(init=False)
    """Number of the first image; annotations count frames by these numbers."""
    frame_count: int = field(init=False)
    size: tuple[int, int] = field(init=False)
    """(width, height) of the first one in pixels."""

    def __post_init__(self) -> None:
        files = sequence_files(self.folder)
        if not files:
            raise UserError(
                f"sequence folder {self.folder} holds no images: accepted are jpg, png and the like"
            )
        if said := left_out([self.folder], files, pictures=True):
            _log.warning("%s: %s", self.folder, said)
        numbers = [_number(file) for file in files]
        for file, number, wanted in zip(
            files, numbers, range(numbers[0], numbers[0] + len(files)), strict=True
        ):
            if number != wanted:
                what = "lacks image" if number > wanted else "has two images of number"
                raise UserError(
                    f"sequence folder {self.folder} {what} {min(wanted, number)} ({file.name} is there)"
                )
        object.__setattr__(self, "first_number", numbers[0])
        object.__setattr__(self, "frame_count", len(files))
        object.__setattr__(self, "size", image_size(files[0]))

    def sequence(
        self,
        *,
        name: str,
        dataset: str,
        fps: float,
        labels: TableLabels | None,
        attributes: Mapping[str, str] | None = None,
    ) -> Sequence:
        """The sequence as a flight plays it. Labels are read once, to name faults before anything is flown.

        Raises `UserError` where labels have nothing in them, and every box would be false; or count frames from
        another number on than images, and all would be of other images.
        """
        frame_count = base_frame_count(self.frame_count / exact_rate(fps), fps=exact_rate(NOMINAL_FPS))
        known = None if labels is None else labels.table()
        begins, count = self.first_number, self.frame_count
        end = begins + count - 1
        span = None if known is None else known.span
        if labels is not None and span is None:
            raise UserError(
                f"annotations {labels.arguments[0]} are empty: accepted are objects or regions within the pictures, "
                "or ?labels=none, for pictures alone"
            )
        first, last = span or (begins, end)
        if (
            not (begins <= last and first <= end)
            or (first < begins and (begins == 1 or last - count in (-1, 0)))
            or (first > begins == 0 and last == count)
        ):
            raise UserError(
                f"sequence folder {self.folder} has images {begins} to {end}, and its annotations are "
                f"of frames {first} to {last}: number them alike"
            )
        found = () if labels is None else (path for path in labels.arguments if isinstance(path, Path))
        return Sequence(
            name=name,
            dataset=dataset,
            clip=Clip(str(self.folder), self.size, max(1, frame_count), source_fps=fps),
            frame_count=self.frame_count,
            fps=fps,
            source_size=self.size,
            labels=labels,
            class_set=() if known is None else known.class_set,
            attributes={
                **(attributes or {}),  # labels beyond the images are no error, but the tables may say so
                **({"annotated beyond": f"frame {last} of {end}"} if last > end else {}),
            },
            files=(self.folder, *found),
        )


def image_size(file: Path) -> tuple[int, int]:
    """(width, height) in pixels; `UserError` for a file that cannot be decoded."""
    if (image := read_image(file)) is None:
        raise UserError(f"{file} cannot be read as an image")
    return image.shape[1], image.shape[0]


def find_folders(root: Path, *, depth: int) -> list[Path]:
    """``root`` and its folders down to so many levels, in natural order of names; hidden ones are left out."""
    found = [root]
    level = [root]
    for _ in range(depth):
        level = [
            folder
            for parent in level
            for folder in sorted(parent.iterdir(), key=_natural)
            if not folder.name.startswith(".") and folder.is_dir()
        ]
        found += level
    return found


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _number(file: Path) -> int:
    """The last number in the name: 0000001.jpg, img000001.jpg, frame_0001.png."""
    digits = re.findall(r"[0-9]+", file.stem)
    if not digits:
        raise UserError(f"image {file} has no number in its name, which says the frame that it is")
    return int(digits[-1][-15:])


_NAMED = (
    ".mp4 .m4v .mov .mkv .webm .avi .wmv .flv .ts .mts .m2ts .mpg .mpeg .3gp .ogv "
    ".y4m .h264 .264 .h265 .265 .hevc .ivf .mxf"
)
_ENDINGS = frozenset(_NAMED.split())
_ANY_SIZE = (64, 64)


def open_clips(place: Path, options: Options) -> Mapping[str, Callable[[], Sequence]]:
    """Every video by name, opened when called; a folder of images and no video is one clip.

    Raises `UserError` where there is none.
    """
    if place.is_file():
        return {place.stem: partial(_open, place.stem, place, options)}
    files = sorted(one for one in place.glob("[!.]*") if one.suffix.lower() in _ENDINGS and one.is_file())
    if not files and (images := sequence_files(place)):
        return {place.name: partial(_open_images, place, images, options)}
    if not files:
        endings = ", ".join(sorted(ending[1:] for ending in _ENDINGS))
        raise UserError(
            f"clips folder {place} holds neither videos nor images: accepted endings are {endings}"
        )
    stems = [file.stem for file in files]
    names = [file.name if stems.count(file.stem) > 1 else file.stem for file in files]
    return {name: partial(_open, name, file, options) for name, file in zip(names, files, strict=True)}


def _open_images(place: Path, images: Words[Path], options: Options) -> Sequence:
    fps = options.fps or NOMINAL_FPS
    played = base_frame_count(len(images) / exact_rate(fps), fps=exact_rate(NOMINAL_FPS))
    clip = Clip(str(place), image_size(images[0]), max(1, played), source_fps=fps)
    return _unlabelled(place.name, place, clip, frame_count=len(images), fps=fps)


def _open(name: str, path: Path, options: Options) -> Sequence:
    settings = SourceSettings(size=_ANY_SIZE, fps=NOMINAL_FPS, source_fps=options.fps)
    source = VideoSource(str(path), settings)
    size, fps = source.view.source_size, source.source_fps
    count, shown = source.shown_frames()
    source.close()
    clip = Clip(str(path), size, len(shown), source_fps=options.fps)
    found = _unlabelled(name, path, clip, frame_count=count, fps=fps)
    given = {} if options.fps is None else {"rate": "given"}  # in place of time stamps of the very same mean
    return replace(found, source_frames=shown, attributes=given)


def _unlabelled(name: str, place: Path, clip: Clip, *, frame_count: int, fps: float) -> Sequence:
    return Sequence(
        name=name,
        dataset="clips",
        clip=clip,
        frame_count=frame_count,
        fps=fps,
        source_size=clip.source_size,
        labels=None,
        class_set=(),
        files=(place,),
    )
