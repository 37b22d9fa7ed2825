"""The codes read with each method at each rate: hybrids at the budget, video at the bits that they spent.

Video is matched to the hybrid that spent most at a rate, so that it never has fewer bits than they.
``M0-best`` is video at the size and frame rate at which most codes are read, chosen for each scene after the flight:
nobody could choose better.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from hvt_common.errors import UserError
from hvt_study.datasets.layouts.uri import open_datasets
from hvt_study.reading.flight import CHANNELS, Channel, ReadFlight, Readings
from hvt_study.reading.score import ChannelScore, Code, CodeReader, Evidence, channel_score
from hvt_study.runs.spec import ModelChoice, RunSpec

READ_METHODS: Mapping[str, tuple[str, str, tuple[str, ...]]] = {
    "source": ("", "", ()),
    "M0": ("M0", "jpeg", ()),
    "M0-best": ("M0", "jpeg", ()),
    "M2-residual": ("M2", "residual", ()),
    "M5-jpeg": ("M5", "jpeg", ()),
    "M5-residual": ("M5", "residual", ()),
    "M6": ("M6", "residual", ()),
    "auto": ("auto", "residual", ()),
    "M6-detail": ("M6", "residual", ("detail_weight=5",)),
}
"""(method, still codec, tuning) by the name in tables. ``source`` is the untouched source, read without any link."""
_VIDEO = ("M0", "M0-best")
_FPS_CHOICES = (15.0, 5.0, 2.0, 1.0, 0.5)
_MOST_FPS_LARGE = 5.0
_HEIGHT_EDGES_PX = (0.0, 8.0, 11.0, 1e6)


@dataclass(frozen=True, slots=True)
class ReadPlan:
    """The plan of a comparison by reading."""

    dataset: str
    """URI of scenes with codes, such as ``demo:0-2,codes``."""
    models: ModelChoice
    rates_bps: tuple[int, ...]
    cache: Path
    methods: tuple[str, ...] = tuple(READ_METHODS)
    size: tuple[int, int] = (1280, 720)
    """(width, height) of the base stream."""
    max_frames: int | None = None

    def sizes(self, source_size: tuple[int, int]) -> tuple[tuple[int, int], ...]:
        """Sizes of video that ``M0-best`` may have: the base's, and larger ones up to the source's own."""
        larger = (size for size in ((1920, 1080), source_size) if self.size < size <= source_size)
        return tuple(dict.fromkeys((self.size, *larger)))


@dataclass(frozen=True, slots=True)
class SceneReading:
    """One scene with one method at one rate."""

    scene: str
    codes: Mapping[int, Code]
    flight: ReadFlight


@dataclass(frozen=True, slots=True)
class ReadRow:
    """One method at one rate over all scenes."""

    rate_kbps: float
    method: str
    scenes: tuple[SceneReading, ...]

    def codes(self) -> list[Code]:
        return [code for code, _ in self._pooled("base")]

    def score(self, channel: Channel, *, heights_px: tuple[float, float] = (0.0, 1e6)) -> ChannelScore:
        """Score over the codes of all scenes whose characters have such a height."""
        low, high = heights_px
        chosen = [(code, one) for code, one in self._pooled(channel) if low <= code.height_px < high]
        return channel_score([code for code, _ in chosen], {code.object_id: one for code, one in chosen})

    def by_height(self, channel: Channel) -> list[ChannelScore]:
        """For characters below 8 pixels, from 8, and from 11 on."""
        return [self.score(channel, heights_px=edges) for edges in pairwise(_HEIGHT_EDGES_PX)]

    def mean(self, name: str) -> float:
        return float(sum(getattr(one.flight, name) for one in self.scenes) / len(self.scenes))

    def _pooled(self, channel: Channel) -> list[tuple[Code, Evidence]]:
        pairs = (
            (code, one.flight.evidence[channel].get(code.object_id, Evidence()))
            for one in self.scenes
            for code in one.codes.values()
        )
        return [(replace(code, object_id=number), found) for number, (code, found) in enumerate(pairs)]

    def figures(self) -> dict[str, Any]:
        """For JSON; docs/legibility.md defines them."""
        found: dict[str, Any] = {
            "rate_kbps": self.rate_kbps,
            "method": self.method,
            "codes": len(self.codes()),
        }
        found |= {name: round(self.mean(name)) for name in ("total_bps", "base_bps", "roi_bps")}
        for channel in CHANNELS:
            score = self.score(channel)
            heights = [_rounded(one.read) for one in self.by_height(channel)]
            found[channel] = {
                "read": _rounded(score.read),
                "median_s": _rounded(score.median_s),
                "misread": _rounded(score.misread),
                "read_by_height": heights,
            }
        found["scenes"] = [_scene_figures(one) for one in self.scenes]
        return found


@dataclass(frozen=True, slots=True)
class ReadResult:
    """All rows, by rate, then in the table's order of methods."""

    rows: tuple[ReadRow, ...]
    missing: tuple[tuple[float, str, str], ...]
    """(rate in kbps, method, why) of flights that failed."""
    reader: str


def compare_codes(plan: ReadPlan, *, on_flight: Callable[[int, int], None] = lambda *_: None) -> ReadResult:
    """Fly and read everything; ``on_flight(done, of)`` is called after each method at each rate over each scene.

    Raises `UserError` where a scene has no codes, the reader is not installed, or models cannot be used.
    """
    scenes = [one for _, one in open_datasets((plan.dataset,))]
    if any(one.codes is None for one in scenes):
        raise UserError(
            f"{plan.dataset} has nothing to read: accepted are drawn scenes with codes, such as demo:codes or "
            "demo:0-4,codes,4k"
        )
    reader = CodeReader()
    flown = [name for name in plan.methods if name != "source"]
    of = len(scenes) * (len(plan.rates_bps) * len(flown) + ("source" in plan.methods))
    found: dict[tuple[int, str], list[SceneReading]] = {}
    missing: list[tuple[float, str, str]] = []
    done = 0
    for scene in scenes:
        spec = _spec(plan, scene.name, plan.rates_bps[0], "M0")
        readings = Readings(spec, reader=reader, cache=plan.cache)
        for rate_bps, name, flight in _flights(plan, scene.name, readings):
            done += 1
            on_flight(done, of)
            if isinstance(flight, str):
                missing.append((rate_bps / 1e3, name, f"{scene.name}: {flight}"))
            else:
                found.setdefault((rate_bps, name), []).append(
                    SceneReading(scene.name, readings.codes, flight)
                )
    order = list(READ_METHODS)
    rows = sorted(found, key=lambda one: (one[0], order.index(one[1])))
    return ReadResult(
        tuple(ReadRow(rate / 1e3, name, tuple(found[rate, name])) for rate, name in rows),
        tuple(missing),
        reader.name,
    )


def _flights(plan: ReadPlan, scene: str, readings: Readings) -> Iterator[tuple[int, str, ReadFlight | str]]:
    """(rate, method, flight or why there is none) of one scene."""
    if "source" in plan.methods:
        yield 0, "source", readings.source()
    for rate_bps in plan.rates_bps:
        spent: list[int] = []
        for name in plan.methods:
            if name in _VIDEO or name == "source":
                continue
            try:
                flight = readings.flown(_spec(plan, scene, rate_bps, name), budget_bps=rate_bps, fps=None)
                spent.append(flight.total_bps)
                yield rate_bps, name, flight
            except UserError as error:
                yield rate_bps, name, str(error)
        target_bps = max(spent, default=rate_bps)
        for name in (one for one in _VIDEO if one in plan.methods):
            spec = _spec(plan, scene, rate_bps, name)
            video = _best(plan, spec, readings, target_bps) if name == "M0-best" else None
            if name == "M0":
                video = readings.matched(spec, target_bps=target_bps, fps=_FPS_CHOICES[0])
            yield rate_bps, name, video or f"no budget spends {target_bps} bps within one per cent"


def _best(plan: ReadPlan, spec: RunSpec, readings: Readings, target_bps: int) -> ReadFlight | None:
    """The flight of all sizes and frame rates in which most is read, and among equal ones soonest."""
    flown = (
        readings.matched(replace(spec, size=size), target_bps=target_bps, fps=fps)
        for size in plan.sizes(readings.source_size)
        for fps in _FPS_CHOICES
        if size == plan.size or fps <= _MOST_FPS_LARGE
    )

    def worth(flight: ReadFlight) -> tuple[float, float]:
        score = channel_score(readings.codes.values(), flight.evidence["base"])
        return score.read or 0.0, -(1e9 if score.median_s is None else score.median_s)

    return max((one for one in flown if one is not None), key=worth, default=None)


def _spec(plan: ReadPlan, scene: str, rate_bps: int, name: str) -> RunSpec:
    method, codec, tune = READ_METHODS[name]
    return RunSpec(
        dataset=plan.dataset,
        sequence=scene,
        method=method,
        regime=f"{rate_bps / 1e3:g}kbps",
        budget_bps=rate_bps,
        models=plan.models,
        still_codec=codec,
        labels="annotations",
        size=plan.size,
        max_frames=plan.max_frames,
        tune=tune,
    )


def _scene_figures(one: SceneReading) -> dict[str, Any]:
    flight = one.flight
    return {
        "scene": one.scene,
        "size": list(flight.size),
        "fps": _rounded(flight.fps),
        "total_bps": flight.total_bps,
        "codes": [
            {
                "object": code.object_id,
                "text": code.text,
                "height_px": round(code.height_px, 1),
                "first_s": _rounded(code.first_s),
                **{channel: _said(flight.evidence[channel].get(code.object_id)) for channel in CHANNELS},
            }
            for code in one.codes.values()
        ],
    }


def _said(one: Evidence | None) -> dict[str, Any] | None:
    """The first right reading, or else the most confident one; None where the channel never showed the code."""
    if one is None or one.best is None:
        return None
    return {
        "text": one.best.text,
        "confidence": _rounded(one.best.confidence),
        "read_s": _rounded(one.read_s) if one.right else None,
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
