"""Images as a source: a folder of numbered ones, as VisDrone's (0000001.jpg) or UAVDT's, or one TIFF."""

from __future__ import annotations

import logging
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import av.error
import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.units import exact_rate
from hvt_common.values import Frame, Image
from hvt_edge.source.contract import Notes, Source, SourceSettings
from hvt_edge.source.decoding.pictures import Stretch
from hvt_edge.source.resample import Resizer, base_frame_count, capture_time_ns, hold

_log = logging.getLogger(__name__)

_MOSTLY = 0.5
"""Share of the steps from one number to the next that must be 1 for others to be gaps."""
_USUAL = (".jpg", ".jpeg", ".webp", ".bmp", ".png", ".tif", ".tiff")
_ENDINGS = (*_USUAL, ".jpe", ".jfif", ".jp2", ".pgm", ".ppm", ".pnm")
"""Beside usual ones the others are masks or depths of the same pictures; so is 1.png beside 1.jpg, or 1.tif."""
_MOST_SERIES = 10
_LEAST_BANDS, _NEARLY = 4, 0.9
"""Bands of a camera, and the share of its pictures that have each."""
_GREY_AND_ALPHA = (b"\2\1\3\0\2\0\0\0\x10\0\x10\0", b"\1\2\0\3\0\0\0\2\0\x10\0\x10")
"""TIFF's BitsPerSample (258) of 16 and 16, in both orders of bytes: OpenCV keeps eight."""
_JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_RESTARTS_AT_EACH = b"\xff\xdd\0\4\0\1"
"""A JPEG that begins anew at each block: it is whole for FFmpeg wherever it is cut."""
_PNG, _PNG_KIND, _PNG_COLOUR = b"\x89PNG", 25, 2
"""How the file begins, the place of its colour type, and that type's bit for colour."""


def sequence_files(folder: Path) -> list[Path]:
    """The images of a folder in natural order (img2 before img10), without hidden files and subfolders.

    Among names that are times 9.05 comes before 9.5. A TIFF counts as a folder of itself. Raises `UserError` for a
    folder that cannot be read.
    """
    if is_tiff(str(folder)):
        return [folder]
    try:
        files = [file for file in folder.iterdir() if names_picture(file) and file.is_file()]
    except OSError as error:
        raise UserError(
            f"source folder {str(folder)!r} cannot be read ({error.strerror}): name another"
        ) from None
    files = [file for file in files if file.suffix.lower() in _USUAL] or files
    files = _one_a_name(files)
    times = [re.fullmatch(r"(.*?)([0-9]+)\.([0-9]+)", file.stem) for file in files]
    found = [(one[1], int(one[2]), one[3]) for one in times if one]
    least = min((len(fraction) for *_, fraction in found), default=0)
    # A counter behind the dot always has as many digits where one begins with a zero.
    if len(found) == len(files) and any(one[0] == "0" and len(one) > least for *_, one in found):
        return [file for _, file in sorted(zip(found, files, strict=True))]
    return sorted(files, key=lambda file: _natural(file.name))


def _one_a_name(files: list[Path]) -> list[Path]:
    # Of files of one name that of the first ending is shown. A thumbnail has a usual ending too: where in the first
    # such name another file is a larger picture, its ending is the first.
    named: dict[str, list[Path]] = {}
    ranks = {ending: rank for rank, ending in enumerate(_ENDINGS)}
    for file in sorted(files, key=lambda file: (ranks[file.suffix.lower()], file.name)):
        named.setdefault(file.stem, []).append(file)
    alike = next((same for same in named.values() if len(same) > 1), [])
    sizes = [0 if image is None else image.size for image in map(read_picture, alike)]
    if all(sizes) and alike:
        ranks[alike[sizes.index(max(sizes))].suffix.lower()] = -1
    firsts = {name: min(ranks[file.suffix.lower()] for file in same) for name, same in named.items()}
    return [file for file in files if ranks[file.suffix.lower()] == firsts[file.stem]]


def names_picture(file: Path) -> bool:
    """Whether a file of this name, in the folder of a sequence, is one of its images."""
    return file.suffix.lower() in _ENDINGS and not file.name.startswith(".")


def is_tiff(spec: str) -> bool:
    """Whether it is a file of that name: FFmpeg shows one that holds a JPEG black, and levels below 0 as high."""
    return Path(spec).suffix.lower() in {".tif", ".tiff"} and Path(spec).is_file()


def _natural(name: str) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _gaps(files: list[Path]) -> str:
    found = [re.findall(r"[0-9]+", file.stem)[-1:] for file in files]
    numbers = [int(digits[0][-15:]) for digits in found if digits]
    steps = [later - earlier for earlier, later in pairwise(numbers)]
    missing = sum(step - 1 for step in steps if step > 1)
    if not missing or len(numbers) < len(files) or steps.count(1) < _MOSTLY * len(steps):
        return ""
    first = next(file for file, step in zip(files, steps, strict=False) if step > 1)
    return f"{missing} numbers are missing, the first after {first.name}: it is shown as if they were never there"


def _bands(stems: list[str]) -> Counter[str]:
    # Cameras of several bands number them from 1 behind a picture's number: IMG_0001_1 to IMG_0001_5. Of other names
    # none: fewer are a burst, and those from 0 tenths of a second.
    parts = [re.fullmatch(r"(.*[0-9])_(0|[1-9][0-9]?)", stem) for stem in stems]
    pairs = [(one[1], int(one[2])) for one in parts if one]
    counts = Counter(band for _, band in pairs)
    each, most = len({picture for picture, _ in pairs}), len(counts)
    in_a_row = set(counts) == set(range(1, most + 1)) and _LEAST_BANDS <= most < each
    if not in_a_row or len(pairs) < _NEARLY * max(len(stems), each * most):
        return Counter()
    return Counter({f"{re.sub(r'[0-9]+', '#', pairs[0][0])}_{band}": counts[band] for band in counts})


def _series(files: list[Path]) -> str:
    counts = Counter(re.sub(r"[0-9]+", "#", file.stem) for file in files)
    if sum(count > 1 for count in counts.values()) == 1:
        counts = _bands([file.stem for file in files]) or counts
    series = sorted((name, count) for name, count in counts.items() if count > 1)
    if not 1 < len(series) <= _MOST_SERIES:
        return ""
    names = ", ".join(f"{count} {name!r}" for name, count in series)
    return f"it holds several series by their names, and all are shown: {names}"


def left_out(folders: Iterable[Path], shown: Iterable[Path], *, pictures: bool = False) -> str:
    """A sentence on the files in folders, or on their ``pictures`` alone, that are not ``shown``; empty for none."""
    found = {file for folder in folders for file in folder.glob("[!.]*")}.difference(shown)
    kinds = [file for file in found if file.is_file() and (names_picture(file) or not pictures)]
    counts = Counter(file.suffix.lower() or "without one" for file in kinds)
    said = ", ".join(f"{count} {ending}" for ending, count in sorted(counts.items()))
    return said and f"files are left out by their endings, or beside others of their names: {said}"


def _pages(file: Path) -> str:
    # A note that a file holds more than one picture; empty where it does not.
    count = 0
    with suppress(cv2.error):  # its header claims a size that no memory holds
        name: Any = os.fsencode(file)  # OpenCV dies of a text that is no UTF-8
        count = cv2.imcount(name)
    return f"{file.name} holds {count} pictures: of a file the first alone is shown" if count > 1 else ""


class FolderSource(Source):
    """Images in natural order, one every 1 / ``source_fps`` seconds; another size is fitted into the first one's.

    An image that cannot be read is skipped with a warning and the one before is shown in its place, so that the time
    of the others does not shift.
    """

    live = False

    def __init__(self, spec: str, settings: SourceSettings) -> None:
        self.fps = fps = settings.fps
        self._place = Path(spec)
        if settings.growing:
            raise UserError(
                f"source {spec!r} is no video file, and --follow waits for no other: leave it out"
            )
        self._files = sequence_files(self._place)
        if not self._files:
            endings = ", ".join(sorted(ending[1:] for ending in _ENDINGS))
            below = sorted({file.parent.name for file in self._place.glob("[!._]*/*") if names_picture(file)})
            hint = f" of its own, its folder {below[0]!r:.80} does" if below else ""
            raise UserError(f"source folder {spec!r} holds no images{hint}; accepted endings are {endings}")
        notes = Notes(spec)
        self._stretch = Stretch(notes)
        images = ((read_picture(file, self._stretch), file) for file in self._files)
        first, shown = next((one for one in images if one[0] is not None), (None, Path(spec)))
        if first is None:
            raise UserError(
                f"source {spec!r} holds {len(self._files)} image files, none of which can be read"
            )
        if settings.source_fps is None:
            notes(f"images have no time: {fps:g} a second, as --fps says; --source-fps N says another rate")
        notes(_gaps(self._files))
        notes(_series(self._files))
        notes(left_out([self._place], self._files))
        notes(_pages(shown))
        self.notes = notes.taken()
        self._first = first
        self._period_s = 1 / exact_rate(fps if settings.source_fps is None else settings.source_fps)
        size = (first.shape[1], first.shape[0])
        self._resizer = Resizer(size, settings.size, fit=settings.fit, name=spec)
        self.view = self._resizer.view
        whole = base_frame_count(len(self._files) * self._period_s, fps=exact_rate(fps))
        self.frame_count = whole if settings.max_frames is None else min(whole, settings.max_frames)

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        rate = exact_rate(self.fps)
        places = ((place * self._period_s, place) for place in range(len(self._files)))
        shown, image, frame = -1, self._first, None
        for index, place in hold(places, fps=rate, tail_s=self._period_s):
            if index == self.frame_count:
                return
            capture_ns = capture_time_ns(index, fps=rate, start_ns=start_ns)
            if place != shown or frame is None:
                image, shown = self._readable(place, held=image), place
                frame = self._resizer.frame(image, index=index, capture_ns=capture_ns)
            yield replace(frame, index=index, capture_ns=capture_ns)
        with suppress(UserError):  # it has gone meanwhile
            if (more := len(sequence_files(self._place)) - len(self._files)) > 0:
                _log.warning("%s: %d images came after the start and are not shown", self._place, more)

    def _readable(self, place: int, *, held: Image) -> Image:
        image = read_picture(self._files[place], self._stretch, at_s=float(place * self._period_s))
        if image is None:
            other = "first that can" if held is self._first else "one before"
            _log.warning(
                "%s cannot be read as an image; the %s is shown in its place", self._files[place], other
            )
        return held if image is None else image


def read_picture(file: Path, stretch: Stretch | None = None, *, at_s: float = 0.0) -> Image | None:
    """(height, width, 3) uint8 BGR, turned by its EXIF data; None where it is no picture that can be read.

    Deep grey is a sensor's levels: ``stretch`` has those of the pictures before; ``at_s`` is the time at which it is
    shown, in seconds.
    """
    try:
        data = np.fromfile(file, np.uint8)
        if not data.size:
            return None
        image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
        if image is None and _is_whole_jpeg(data.tobytes()):
            data = np.append(data, np.frombuffer(_JPEG_END, np.uint8))
        if image is not None and image.ndim == 2 and image.dtype == np.uint8 and is_tiff(str(file)):
            image = _of_sixteen_bits(data.tobytes(), image)
        deep = stretch or Stretch(lambda _: None)
        if image is not None and image.itemsize > 1:
            if data[:4].tobytes() == _PNG and not data[_PNG_KIND] & _PNG_COLOUR:
                # OpenCV repeats grey that has transparency.
                image = image.reshape(*image.shape[:2], -1)[..., 0]
            if image.ndim == 2:
                return deep.bgr(image, at_s=at_s)
        if image is not None and image.dtype == np.uint16:
            return deep.colours(np.asarray(image, np.uint16)[..., :3])
        if image is None or image.dtype != np.uint8 or image.shape[2:] != (3,):
            # As OpenCV reads them: without transparency, in 8 bits.
            image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except (OSError, cv2.error):  # it has just gone, or its header claims too large a size
        return None
    return None if image is None else np.asarray(image, np.uint8)


def _is_whole_jpeg(data: bytes) -> bool:
    # Some programs leave out the end marker, without which OpenCV takes a JPEG for cut.
    if not data.startswith(_JPEG) or _RESTARTS_AT_EACH in data:
        return False
    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode"}
    with suppress(ValueError, av.error.FFmpegError):
        return bool(decoder.decode(av.Packet(data)))
    return False


def _of_sixteen_bits(tiff: bytes, eight: npt.NDArray[Any]) -> npt.NDArray[Any]:
    # FFmpeg keeps them, but shows tiles (GeoTIFF) black without an error: then the eight that OpenCV keeps.
    if not any(one in tiff for one in _GREY_AND_ALPHA):
        return eight
    with suppress(ValueError, av.error.FFmpegError):
        (frame,) = av.CodecContext.create("tiff", "r").decode(av.Packet(tiff))
        if not frame.format.name.startswith("ya16"):
            return eight
        grey = frame.reformat(format="gray16le").to_ndarray()
        if grey.shape == eight.shape and (grey // 256 + 1 >= eight).all():
            return grey
    return eight.astype(np.uint16) * 257
