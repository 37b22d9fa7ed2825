"""Flights over the drawn scene, compared with the scene's exact truth, and by the codes read in them."""

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hvt_archive.reading.recorded import read_recordings
from hvt_common.errors import UserError
from hvt_common.values import Image
from hvt_common.video.hevc import BaseDecoder
from hvt_scene import CodeInView
from hvt_study.datasets.label_files import read_image
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.demo.picture import Pair, Panel
from hvt_study.metrics.classes import ClassScore
from hvt_study.metrics.judged import FrameView
from hvt_study.metrics.track_table_score import read_tracks, score
from hvt_study.reading.flight import INSIDE_SHARE
from hvt_study.reading.score import LEAST_VISIBLE, Code, CodeReader, code_crop, codes_to_read, share_inside


@dataclass(frozen=True, slots=True)
class FlownStill:
    """A still as it arrived."""

    frame: int
    """That it shows, from 1."""
    place_base_px: tuple[float, float, float, float]
    """x1 y1 x2 y2 of the whole picture in the base picture of that frame."""
    image_bgr: Image


@dataclass(frozen=True, slots=True)
class Flown:
    """One flight."""

    name: str
    tracks: Mapping[int, FrameView]
    """By frame, from 1; base pixels."""
    pictures: Mapping[int, Image]
    """Base pictures as decoded, by frame; those that the stream left out are missing."""
    stills: tuple[FlownStill, ...]
    total_bps: int


def read_flown(folder: Path, name: str) -> Flown:
    """The flight of the edge ``name`` from the files of hvt-edge and hvt-ground in ``folder``.

    Raises `UserError` where a file is missing or of another kind.
    """
    summary = _only(folder, f"{name}-edge.json")
    try:
        total_bps = int(json.loads(summary.read_text(encoding="utf-8"))["total_bps"])
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{summary} is no summary of hvt-edge ({error})") from None
    return Flown(
        name=name,
        tracks=read_tracks(_only(folder, f"hvt-{name}-*.csv")),
        pictures=_pictures(_only(folder, f"hvt-{name}-*.rrd")),
        stills=tuple(_stills(_only(folder / "stills", f"hvt-{name}-*.csv"))),
        total_bps=total_bps,
    )


def _only(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        raise UserError(f"{folder} has {len(found)} files {pattern}: give the folder of one flight of each")
    return found[0]


def _pictures(path: Path) -> dict[int, Image]:
    decoder = BaseDecoder()
    decoded = ((one.frame_index, decoder.decode(one.data)) for one in read_recordings([path]).video)
    return {frame + 1: picture for frame, picture in decoded if picture is not None}


def _stills(path: Path) -> list[FlownStill]:
    stills = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):  # a line an object, one picture
            x, y, w, h = (float(row[one]) for one in "xywh")
            if (image := read_image(path.with_name(row["file"]))) is not None:
                place = (x, y, x + w, y + h)
                stills[row["file"]] = FlownStill(int(row["frame_index"]) + 1, place, image)
    return list(stills.values())


_SOME_PICTURES = 6
"""Base pictures in which a code is read, spread over the time that it is whole in view: reading takes time."""
_CONTEXT = 1.2
"""Around a code where somebody looks at it, in its longer sides."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A still that shows a whole code."""

    object_id: int
    still: FlownStill
    box_base_px: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Legible:
    """The objects whose codes were read right at least once, of one flight."""

    video: frozenset[int]
    stills: Mapping[int, Shown]
    """By object, the first still that was read right."""

    @property
    def every(self) -> frozenset[int]:
        return self.video | self.stills.keys()


@dataclass(frozen=True, slots=True)
class Painted:
    """The codes of the scene that all flights saw."""

    codes: Mapping[int, Code]
    """By object."""
    views: Sequence[Sequence[CodeInView]]
    """By frame, from 0."""
    base_per_source: float


def read_codes_of(flown: Flown, painted: Painted, reader: CodeReader) -> Legible:
    """Read every still that holds a whole code, and each code in some base pictures."""
    codes = painted.codes
    video = {one for one, code in codes.items() if _in_video(flown, code, painted, reader)}
    read: dict[int, Shown] = {}
    for shown in stills_with_codes(flown, painted):
        if shown.object_id not in read:
            crop = code_crop(shown.still.image_bgr, _in_still(shown.still, shown.box_base_px))
            (reading,) = reader.read([crop])
            if reading.text == codes[shown.object_id].text:
                read[shown.object_id] = shown
    return Legible(frozenset(video), read)


def stills_with_codes(flown: Flown, painted: Painted) -> Iterator[Shown]:
    """Every still with each code that lies whole in it."""
    for still in flown.stills:
        place = np.array(still.place_base_px)
        for one in painted.views[still.frame - 1]:
            box, whole = one.box_source_px * painted.base_per_source, one.visible >= LEAST_VISIBLE
            if whole and one.object_id in painted.codes and share_inside(box, place) >= INSIDE_SHARE:
                x1, y1, x2, y2 = box.tolist()
                yield Shown(one.object_id, still, (x1, y1, x2, y2))


def code_pictures(shown: Shown, base: Image) -> tuple[Image, Image]:
    """The same roof for the eye: of a base picture, and of the still; each enlarged."""
    x1, y1, x2, y2 = shown.box_base_px
    reach = _CONTEXT * max(x2 - x1, y2 - y1) / 2
    x, y = (x1 + x2) / 2, (y1 + y2) / 2
    wide = (x - reach, y - reach, x + reach, y + reach)
    return code_crop(base, wide), code_crop(shown.still.image_bgr, _in_still(shown.still, wide))


def _in_video(flown: Flown, code: Code, painted: Painted, reader: CodeReader) -> bool:
    places = [
        (frame, one)
        for frame in flown.pictures
        for one in painted.views[frame - 1]
        if one.object_id == code.object_id and one.visible >= LEAST_VISIBLE
    ]
    some = np.linspace(0, len(places) - 1, min(_SOME_PICTURES, len(places))).round().astype(int)
    for frame, one in (places[number] for number in some.tolist()):
        crop = code_crop(flown.pictures[frame], (one.box_source_px * painted.base_per_source).tolist())
        if reader.read([crop])[0].text == code.text:
            return True
    return False


def _in_still(still: FlownStill, box_base_px: Sequence[float]) -> list[float]:
    x1, y1, x2, _ = still.place_base_px
    scale = still.image_bgr.shape[1] / (x2 - x1)
    return [(value - start) * scale for value, start in zip(box_base_px, (x1, y1, x1, y1), strict=True)]


_PAIRS = 6


@dataclass(frozen=True, slots=True)
class Compared:
    """The flights in the order given; the first is the video that others are held against."""

    flown: tuple[Flown, ...]
    scores: tuple[ClassScore, ...]
    legible: tuple[Legible, ...] | None
    """None where no reader is installed."""
    painted: Painted
    truth: Mapping[int, FrameLabels]
    """By frame, from 1; base pixels."""

    def panels(self) -> list[Panel]:
        """The middle of the flight as each shows it."""
        frame = (len(self.painted.views) + 1) // 2
        return [
            Panel(
                f"{one.name}: named F1 {figures.named_f1:.3f}",
                _newest(one, frame),
                one.tracks.get(frame, FrameView()),
                self.truth[frame],
            )
            for one, figures in zip(self.flown, self.scores, strict=True)
        ]

    def pairs(self) -> list[Pair]:
        """Roofs in the first flight's video and in stills of the last: those only in stills first, then by size."""
        video, last = self.flown[0], self.flown[-1]
        known = frozenset() if self.legible is None else self.legible[0].every
        if self.legible is not None and self.legible[-1].stills:
            shown = list(self.legible[-1].stills.values())
        else:
            shown = list({one.object_id: one for one in stills_with_codes(last, self.painted)}.values())
        codes = self.painted.codes
        shown.sort(key=lambda one: (one.object_id in known, codes[one.object_id].height_px))
        pairs = []
        for one in shown[:_PAIRS]:
            code = codes[one.object_id].text
            left, right = code_pictures(one, _newest(video, one.still.frame))
            if self.legible is None:
                words = f"video of {video.name}", f"still; painted: {code}"
            else:
                read = one.object_id in self.legible[-1].stills
                seen = f"read: {code}" if one.object_id in known else "not read"
                words = f"{video.name}: {seen}", f"still: {code if read else 'not read'}"
            pairs.append(Pair(left, right, *words))
        return pairs


def compare_flown(folder: Path, names: Sequence[str], *, seed: int, with_reader: bool) -> Compared:
    """Compare the flights of edges of these names in ``folder``; see `hvt_study.demo.compared.read_flown`."""
    flown = tuple(read_flown(folder, name) for name in names)
    (scene,) = open_dataset(f"demo:{seed},codes")
    assert scene.labels is not None, "a drawn scene says what is in it"
    assert scene.codes is not None, "codes were asked for"
    sizes = {picture.shape[:2] for one in flown for picture in one.pictures.values()}
    if len(sizes) != 1:
        raise UserError(f"the flights in {folder} have base streams of {len(sizes)} sizes: fly them with one")
    ((high, wide),) = sizes
    scale = wide / scene.source_size[0]
    frames = range(max(max(one.pictures) for one in flown))
    truth = {index + 1: _scaled(scene.labels(index), scale) for index in frames}
    views = [scene.codes(index) for index in frames]
    painted, legible = Painted(codes_to_read(views), views, scale), None
    if with_reader:
        with ThreadPoolExecutor(len(flown)) as pool:  # the networks let other threads run
            legible = tuple(pool.map(lambda one: read_codes_of(one, painted, CodeReader()), flown))
    scores = tuple(score(one.tracks, truth, frame_area_px=wide * high) for one in flown)
    return Compared(flown, scores, legible, painted, truth)


def _scaled(labels: FrameLabels, scale: float) -> FrameLabels:
    boxes, beside = labels.boxes_xyxy_px * scale, labels.beside_xyxy_px * scale
    return replace(labels, boxes_xyxy_px=boxes, beside_xyxy_px=beside)


def _newest(one: Flown, frame: int) -> Image:
    """The base picture that was newest at a frame; grey before the first."""
    before = [number for number in one.pictures if number <= frame]
    if before:
        return one.pictures[max(before)]
    return np.full_like(next(iter(one.pictures.values())), 128)
