"""Flights over the drawn scene, compared: each against the scene's exact truth, and by what can be read of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError
from hvt_common.values import Image
from hvt_scene import CodeInView
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.demo.flown import Flown, read_flown
from hvt_study.demo.legible import Legible, code_pictures, read_codes_of, stills_with_codes
from hvt_study.demo.picture import Pair, Panel
from hvt_study.metrics.classes import ClassScore
from hvt_study.metrics.frames import FrameView
from hvt_study.metrics.track_table_score import score
from hvt_study.reading.reader import CodeReader
from hvt_study.reading.score import Code, codes_to_read

_PAIRS = 6


@dataclass(frozen=True, slots=True)
class Compared:
    """The flights in the order given; the first is the video that others are held against."""

    flown: tuple[Flown, ...]
    scores: tuple[ClassScore, ...]
    legible: tuple[Legible, ...] | None
    """None where no reader is installed."""
    codes: Mapping[int, Code]
    """What there was to read."""
    truth: Mapping[int, FrameLabels]
    """By frame, from 1; base pixels."""
    views: Sequence[Sequence[CodeInView]]
    """By frame, from 0."""
    base_per_source: float

    def panels(self) -> list[Panel]:
        """The middle of the flight as each shows it."""
        frame = (len(self.views) + 1) // 2
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
        """Roofs in the first flight's video and in stills of the last: what only these show first, then by size."""
        video, last = self.flown[0], self.flown[-1]
        known = frozenset() if self.legible is None else self.legible[0].every
        if self.legible is not None and self.legible[-1].stills:
            shown = list(self.legible[-1].stills.values())
        else:
            every = stills_with_codes(last, self.codes, self.views, base_per_source=self.base_per_source)
            shown = list({one.object_id: one for one in every}.values())
        shown.sort(key=lambda one: (one.object_id in known, self.codes[one.object_id].height_px))
        pairs = []
        for one in shown[:_PAIRS]:
            code = self.codes[one.object_id].text
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
    """Compare what edges of these names left in ``folder``; see `hvt_study.demo.flown.read_flown`."""
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
    codes = codes_to_read(views)

    def read(one: Flown) -> Legible:
        return read_codes_of(one, codes, views, base_per_source=scale, reader=CodeReader())

    legible = None
    if with_reader:
        with ThreadPoolExecutor(len(flown)) as pool:  # the networks let other threads run
            legible = tuple(pool.map(read, flown))
    scores = tuple(score(one.tracks, truth, frame_area_px=wide * high) for one in flown)
    return Compared(flown, scores, legible, codes, truth, views, scale)


def _scaled(labels: FrameLabels, scale: float) -> FrameLabels:
    boxes, beside = labels.boxes_xyxy_px * scale, labels.beside_xyxy_px * scale
    return replace(labels, boxes_xyxy_px=boxes, beside_xyxy_px=beside)


def _newest(one: Flown, frame: int) -> Image:
    """The base picture that was newest at a frame; grey before the first."""
    before = [number for number in one.pictures if number <= frame]
    if before:
        return one.pictures[max(before)]
    return np.full_like(next(iter(one.pictures.values())), 128)
