"""Keeps a flight that was flown again beside the table, so that a report can be made again without flying."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_common.errors import FlightError, UserError
from hvt_common.runtime.reporting import write_json
from hvt_common.values import Image
from hvt_study.report.example.choice import CropExample, Example, Lane, Timeline, Word

_FOLDER = "example"
_FILE = "example.json"
_PICTURES = ("source", "base", "still")


def save_example(folder: Path, example: Example) -> None:
    """Write ``example/example.json`` and its pictures in a study's folder.

    Raises:
        UserError: it cannot be written.
    """
    place = folder / _FOLDER
    content = asdict(example)
    try:
        place.mkdir(parents=True, exist_ok=True)
        for crop in content["crops"]:
            for name in _PICTURES:
                (place / f"{crop['percentile']}-{name}.png").write_bytes(crop.pop(f"{name}_png"))
        write_json(place / _FILE, content)
    except (OSError, FlightError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"{place} cannot be written ({why}): name a folder that can") from None


def load_example(folder: Path) -> Example | None:
    """What was saved; None where nothing was.

    Raises:
        UserError: it is damaged.
    """
    place = folder / _FOLDER
    try:
        content = json.loads((place / _FILE).read_text(encoding="utf-8"))
        return _example(content, place)
    except FileNotFoundError:
        if not (place / _FILE).exists():
            return None
        raise UserError(f"{place} lacks a picture: remove the folder, and the report does without") from None
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(
            f"{place / _FILE} is damaged: remove the folder, and the report does without"
        ) from None


def _example(content: Mapping[str, Any], place: Path) -> Example:
    crops = tuple(_crop(crop, place) for crop in content["crops"])
    return Example(**{**content, "crops": crops, "timeline": _timeline(content["timeline"])})


def _crop(content: Mapping[str, Any], place: Path) -> CropExample:
    pictures: dict[str, Any] = {
        f"{name}_png": (place / f"{content['percentile']}-{name}.png").read_bytes() for name in _PICTURES
    }
    if not all(map(_is_picture, pictures.values())):
        raise ValueError("a picture is damaged")
    return CropExample(**{**content, **pictures})


def _timeline(content: Mapping[str, Any]) -> Timeline:
    lanes = tuple(
        Lane(
            lane["track_id"],
            tuple((float(first), float(last)) for first, last in lane["spans_s"]),
            tuple(Word(**word) for word in lane["words"]),
        )
        for lane in content["lanes"]
    )
    series = {name: tuple(value) for name, value in content.items() if isinstance(value, list)}
    return Timeline(**{**content, **series, "lanes": lanes})


def _is_picture(png: bytes) -> bool:
    """Whether it can be decoded."""
    return bool(png) and cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) is not None


def enlarged(png: bytes, *, least_px: int) -> bytes:
    """The PNG by the least whole factor that makes its longer side ``least_px``: every pixel becomes a square.

    Readers of papers and Markdown smooth what they enlarge themselves.
    """
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None, "pictures are looked at where they are read"
    factor = -(-least_px // max(image.shape[:2]))
    return png_of(np.asarray(image.repeat(factor, axis=0).repeat(factor, axis=1), np.uint8))


def png_of(image_bgr: Image) -> bytes:
    """The picture as a file."""
    done, data = cv2.imencode(".png", image_bgr)
    assert done, "it has pixels"
    return data.tobytes()
