"""What a flight left in its folder: its tracks, the pictures of its base stream, its stills and what they cost."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hvt_archive.reading.recorded import read_recordings
from hvt_common.errors import UserError
from hvt_common.values import Image
from hvt_common.video.hevc import BaseDecoder
from hvt_study.metrics.frames import FrameView
from hvt_study.metrics.track_table_score import read_tracks


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
    """The flight of the edge ``name`` from what hvt-edge and hvt-ground wrote into ``folder``.

    Raises:
        UserError: a file is missing or is not what it should be.
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
            image = cv2.imread(str(path.with_name(row["file"])), cv2.IMREAD_COLOR)
            if image is not None:
                place = (x, y, x + w, y + h)
                stills[row["file"]] = FlownStill(
                    int(row["frame_index"]) + 1, place, np.asarray(image, np.uint8)
                )
    return list(stills.values())
