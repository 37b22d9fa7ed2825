"""Clips without annotations: a video, a folder of videos, or a folder of images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Words
from dataclasses import replace
from functools import partial
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.units import exact_rate
from hvt_edge.source.contract import SourceSettings
from hvt_edge.source.folder import sequence_files
from hvt_edge.source.resample import base_frame_count
from hvt_edge.source.video import VideoSource
from hvt_study.datasets.clip import NOMINAL_FPS, Clip
from hvt_study.datasets.layouts.image_sequence import image_size
from hvt_study.datasets.layouts.options import Options
from hvt_study.datasets.sequence import Sequence

_NAMED = (
    ".mp4 .m4v .mov .mkv .webm .avi .wmv .flv .ts .mts .m2ts .mpg .mpeg .3gp .ogv "
    ".y4m .h264 .264 .h265 .265 .hevc .ivf .mxf"
)
_ENDINGS = frozenset(_NAMED.split())
_ANY_SIZE = (64, 64)


def open_clips(place: Path, options: Options) -> Mapping[str, Callable[[], Sequence]]:
    """Every video by name, opened when called; a folder of images and no video is one clip.

    Raises:
        UserError: there is none.
    """
    if place.is_file():
        return {place.stem: partial(_open, place.stem, place, options)}
    files = sorted(file for file in place.iterdir() if file.suffix.lower() in _ENDINGS and file.is_file())
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
    return replace(_unlabelled(name, path, clip, frame_count=count, fps=fps), source_frames=shown)


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
