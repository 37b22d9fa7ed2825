"""A sequence as a folder of numbered images: what is there, and what is missing."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from hvt_common.errors import UserError
from hvt_common.units import exact_rate
from hvt_edge.source.folder import sequence_files
from hvt_edge.source.resample import base_frame_count
from hvt_study.datasets.clip import NOMINAL_FPS, Clip
from hvt_study.datasets.label_table import LabelTable, TableLabels
from hvt_study.datasets.sequence import Sequence


@dataclass(frozen=True, slots=True)
class ImageSequence:
    """Images of one folder in the order of their numbers.

    Raises:
        UserError: there is none, one has no number, a number is missing or twice there, or the first is not an image.
    """

    folder: Path
    first_number: int = field(init=False)
    """Of the first image; annotations count frames by these numbers."""
    frame_count: int = field(init=False)
    size: tuple[int, int] = field(init=False)
    """(width, height) of the first one in pixels."""

    def __post_init__(self) -> None:
        files = sequence_files(self.folder)
        if not files:
            raise UserError(
                f"sequence folder {self.folder} holds no images: accepted are jpg, png and the like"
            )
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
        """The sequence as a flight plays it. Labels are read once, to say what is wrong before anything is flown.

        Raises `UserError` where labels count frames from 0 and images from 1: all labels would be a frame late.
        """
        frame_count = base_frame_count(self.frame_count / exact_rate(fps), fps=exact_rate(NOMINAL_FPS))
        known = None if labels is None else labels.table()
        if known is not None and known.first_frame == 0 and self.first_number == 1:
            raise UserError(
                f"sequence folder {self.folder} counts its images from 1, and its annotations count frames from 0: "
                "number them alike"
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
            attributes={**(attributes or {}), **self._unlike(known)},
            files=(self.folder, *found),
        )

    def _unlike(self, known: LabelTable | None) -> dict[str, str]:
        """Labels of more frames than there are images are no error, but the tables may say so."""
        last = self.first_number + self.frame_count - 1
        if known is None or known.last_frame <= last:
            return {}
        return {"annotated beyond": f"frame {known.last_frame} of {last}"}


def image_size(file: Path) -> tuple[int, int]:
    """(width, height) in pixels; `UserError` for what cannot be decoded."""
    data = np.fromfile(file, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
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
            for folder in sorted(parent.iterdir(), key=lambda path: _natural(path.name))
            if not folder.name.startswith(".") and folder.is_dir()
        ]
        found += level
    return found


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _number(file: Path) -> int:
    """The last number in the name: 0000001.jpg, img000001.jpg, frame_0001.png."""
    digits = re.findall(r"[0-9]+", file.stem)
    if not digits:
        raise UserError(f"image {file} has no number in its name, which says the frame that it is")
    return int(digits[-1][-15:])
