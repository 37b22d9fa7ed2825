"""What runs have in common beside their networks, out of a row's configuration; and how two runs differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from hvt_study.runs.spec import said_run, table_of


@dataclass(frozen=True, slots=True, order=True)
class Conditions:
    """Of a flight; the defaults are those of ``hvt-study run``."""

    size: tuple[int, int] = (1280, 720)
    """(width, height) of the base stream in pixels."""
    detect_every: int = 5
    max_frames: int = 0
    """0: the whole clip."""
    refine: str = "fuse"

    def unusual(self) -> Iterator[str]:
        """What is not as usual, in words."""
        if self.size != USUAL.size:
            yield f"base of {self.size[0]}x{self.size[1]}"
        if self.detect_every != USUAL.detect_every:
            every = "every frame" if self.detect_every == 1 else f"one frame in {self.detect_every}"
            yield f"detection on {every}"
        if self.max_frames != USUAL.max_frames:
            yield f"at most {self.max_frames} frames of each"
        if self.refine != USUAL.refine:
            yield f"--refine {self.refine}"


USUAL = Conditions()


def conditions_of(row: Mapping[str, Any]) -> Conditions:
    """Out of ``config``; what it does not say is as usual."""
    return _said(row["config"])[0]


def tune_of(row: Mapping[str, Any]) -> tuple[str, ...]:
    """``KEY=VALUE`` of the method's parameters other than their defaults."""
    return _said(row["config"])[1]


def how_they_differ(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Where the configurations of two rows part, ``tune: none and a=1``; else their software, contents or totals."""
    for left, right in (
        (said_run(one), said_run(other)),
        *((table_of(one[column]), table_of(other[column])) for column in ("versions", "content")),
    ):
        ours, theirs = _flat(left), _flat(right)
        parts = [name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name)]
        if parts:
            return "; ".join(
                f"{name}: {_word(ours.get(name))} and {_word(theirs.get(name))}" for name in parts
            )
    return f"total_bps: {one['total_bps']} and {other['total_bps']}"


@lru_cache(maxsize=100_000)
def _said(config: str) -> tuple[Conditions, tuple[str, ...]]:
    """Every caption asks for it."""
    run = said_run({"config": config})
    models = run.get("models")
    size = run.get("size") or USUAL.size
    conditions = Conditions(
        size=(int(size[0]), int(size[1])),
        detect_every=int(run.get("detect_every") or USUAL.detect_every),
        max_frames=int(run.get("max_frames") or USUAL.max_frames),
        refine=str((models.get("refine") if isinstance(models, Mapping) else None) or USUAL.refine),
    )
    return conditions, tuple(map(str, run.get("tune") or ()))


def _flat(content: Mapping[str, Any]) -> dict[str, Any]:
    """Without levels; the target is another run's, and has been compared."""
    found: dict[str, Any] = {}
    for name, value in content.items():
        found |= _flat(value) if isinstance(value, Mapping) and name != "target" else {name: value}
    found.pop("target", None)
    return found


def _word(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value)) or "none"
    return "none" if value in (None, "") else str(value)
