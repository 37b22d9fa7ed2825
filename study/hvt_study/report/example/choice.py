"""One flight of a study from close by: chosen by rule, with the results of its stills, second by second."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_common.errors import FlightError, UserError
from hvt_common.files import write_whole
from hvt_common.runtime.reporting import write_json
from hvt_common.values import Image
from hvt_study.report.data.arms import Arm, BySequence, RunRow, Setting, is_video, settings, values
from hvt_study.report.data.pairs import pairs

PERCENTILES = (10, 50, 90)
"""Percentiles of the gain in PSNR at which the stills that are shown lie."""
_GAIN = "named_f1"
_PREFERRED = "M6"


@dataclass(frozen=True, slots=True)
class Choice:
    """A run to be shown."""

    key: str
    rule: str
    """Why this one; the end of a sentence."""


@dataclass(frozen=True, slots=True)
class CropExample:
    """One still beside the source and the base at its place; three pictures of one size, PNG."""

    percentile: int
    gain_db: float
    """Y-PSNR of the still less that of the base, both against the source."""
    base_db: float
    at_s: float
    """Capture of its frame, from the first frame."""
    track_id: int
    class_before: str
    class_after: str
    size_bytes: int
    source_png: bytes
    base_png: bytes
    still_png: bytes


@dataclass(frozen=True, slots=True)
class Word:
    """A still's class for a track, and when."""

    at_s: float
    before: str
    after: str


@dataclass(frozen=True, slots=True)
class Lane:
    """A track of the ground that stills have named."""

    track_id: int
    spans_s: tuple[tuple[float, float], ...]
    """From and to, when it was listed."""
    words: tuple[Word, ...]


@dataclass(frozen=True, slots=True)
class Timeline:
    """A flight in steps of one second; lists are as long as it has seconds."""

    budget_bps: int
    base_kbps: tuple[float, ...]
    roi_kbps: tuple[float, ...]
    other_kbps: tuple[float, ...]
    f1: tuple[float, ...]
    """F1 of the list, whatever the classes."""
    named_before: tuple[float, ...]
    """Found & named, without the stills' word."""
    named: tuple[float, ...]
    lanes: tuple[Lane, ...]
    """Tracks whose class changed most often first, then those with the most words; not all of them."""
    tracks_named: int


@dataclass(frozen=True, slots=True)
class Example:
    """A flight that was flown again to be looked at."""

    key: str
    digest: str
    """Digest of all payloads, as in its row: it is the same flight."""
    rule: str
    title: str
    """Sequence, method, regime and labels, in words."""
    stills: int
    crops: tuple[CropExample, ...]
    timeline: Timeline


def choose_run(rows: Sequence[RunRow]) -> Choice | None:
    """The run of the sequence with the median gain, of those that sent stills; None where no such method counts.

    Of the methods that sent stills M6 is taken, or the last in the order of tables; in the thinnest regime; with the
    codec that comes first. Gain is in named F1, against M0 at the same total; without M0, against the same run
    without the stills' word. Where no run sent a still, the rule goes by all of them: there is a timeline still.
    Raises `UserError` where two different runs count at one place.
    """
    found = settings(rows)
    return _first(found, _that_sent) or _first(found, Setting.runs)


def percentile_rows(gains_db: Sequence[float]) -> list[tuple[int, int]]:
    """(percentile, index) of the stills nearest to `PERCENTILES` of the gain, each once; a lone one is the middle."""
    order = sorted(range(len(gains_db)), key=lambda index: (gains_db[index], index))
    if len(order) == 1:
        return [(50, 0)]
    found: dict[int, int] = {}
    for percentile in PERCENTILES if order else ():
        found.setdefault(order[round(percentile / 100 * (len(order) - 1))], percentile)
    return [(percentile, index) for index, percentile in found.items()]


def _preferred(arms: Sequence[Arm], setting: Setting) -> Arm:
    method = _PREFERRED if any(arm.method == _PREFERRED for arm in arms) else arms[-1].method
    codecs = list(dict.fromkeys(row["still_codec"] for row in setting.rows))
    return min((arm for arm in arms if arm.method == method), key=lambda arm: codecs.index(arm.still_codec))


def _first(found: Sequence[Setting], take: Callable[[Setting, Arm], BySequence]) -> Choice | None:
    for setting in found:
        for regime in setting.regimes:
            arms = [arm for arm in setting.hybrids(regime) if arm.still_codec and take(setting, arm)]
            if arms:
                arm = _preferred(arms, setting)
                return _median(setting, arm, take(setting, arm))
    return None


def _that_sent(setting: Setting, arm: Arm) -> BySequence:
    return {name: row for name, row in setting.runs(arm).items() if row["stills"]}


def _median(setting: Setting, arm: Arm, runs: BySequence) -> Choice:
    assert not is_video(arm.method), "video sends no stills"
    sent = "with stills" if any(row["stills"] for row in runs.values()) else "(no run sent a still)"
    gains, over = _gains(setting, arm, runs)
    ordered = sorted(gains, key=lambda name: (gains[name], name)) or sorted(runs)
    name = ordered[(len(ordered) - 1) // 2]
    how = f"with the median gain in named F1 over {over}" if gains else "in the middle by name"
    where = f"{arm.name} in the thinnest regime with such runs ({arm.regime})"
    if len(ordered) == 1:
        return Choice(str(runs[name]["key"]), f"{where}, which has one sequence {sent}")
    rule = f"{where}, and of its {len(ordered)} sequences {sent} the one {how}"
    return Choice(str(runs[name]["key"]), rule)


def _gains(setting: Setting, arm: Arm, runs: BySequence) -> tuple[Mapping[str, float], str]:
    """In named F1 by sequence, and the reference."""
    for pair in (one for one in pairs(setting, references=("M0",)) if one.arm == arm):
        against = {name: gap for name, gap in pair.gaps(_GAIN).items() if name in runs}
        if against:
            return against, "M0 at the same total"
    after, before = values(runs, _GAIN), values(runs, f"{_GAIN}_before")
    own = {name: after[name] - before[name] for name in runs}
    return {name: gap for name, gap in own.items() if not math.isnan(gap)}, "itself without stills"


_FOLDER = "example"
_FILE = "example.json"
_PICTURES = ("source", "base", "still")


def save_example(folder: Path, example: Example) -> None:
    """Write ``example/example.json`` and its pictures in a study's folder; `UserError` where it cannot be written."""
    place = folder / _FOLDER
    content = asdict(example)
    try:
        place.mkdir(parents=True, exist_ok=True)
        for crop in content["crops"]:
            for name in _PICTURES:
                write_whole(place / f"{crop['percentile']}-{name}.png", crop.pop(f"{name}_png"))
        write_json(place / _FILE, content)
    except (OSError, FlightError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"{place} cannot be written ({why}): name a folder that can") from None


def load_example(folder: Path) -> Example | None:
    """The saved example; None where there is none. `UserError` where it is damaged."""
    place = folder / _FOLDER
    try:
        content = json.loads((place / _FILE).read_text(encoding="utf-8"))
        crops = tuple(_crop(crop, place) for crop in content["crops"])
        return Example(**{**content, "crops": crops, "timeline": _timeline(content["timeline"])})
    except FileNotFoundError:
        if not (place / _FILE).exists():
            return None
        raise UserError(f"{place} lacks a picture: remove the folder, and the report does without") from None
    except (OSError, ValueError, RecursionError, KeyError, TypeError):
        raise UserError(
            f"{place / _FILE} is damaged: remove the folder, and the report does without"
        ) from None


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
    return bool(png) and cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) is not None


def enlarged(png: bytes, *, least_px: int) -> bytes:
    """The PNG by the least whole factor that makes its longer side ``least_px``: every pixel becomes a square.

    Programs that show papers and Markdown smooth the pictures that they enlarge themselves.
    """
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None, "pictures are looked at where they are read"
    factor = -(-least_px // max(image.shape[:2]))
    return png_of(np.asarray(image.repeat(factor, axis=0).repeat(factor, axis=1), np.uint8))


def png_of(image_bgr: Image) -> bytes:
    done, data = cv2.imencode(".png", image_bgr)
    assert done, "it has pixels"
    return data.tobytes()
