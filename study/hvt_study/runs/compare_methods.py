"""The methods that ``hvt-study sight`` compares, each as settings of the edge; nothing else makes them differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from hvt_common.errors import UserError

__all__ = ["FPS_CHOICES", "METHODS", "MethodRow", "method_rows"]

FPS_CHOICES = (15.0, 7.5, 5.0, 3.0, 2.0, 1.0)
"""Fixed frame rates of which ``M0-fps`` takes the best."""

_VIDEO_ONLY = ("--method", "M0")
# Video alone asks nothing of the edge's own eyes: it is not charged for them either.
_BLIND = ("--detect-every", "1000", "--camera-motion", "off")
_SOURCE = ("--candidates", "source", "--tiles", "auto", "--send-tracks")


@dataclass(frozen=True, slots=True)
class MethodRow:
    """One method."""

    name: str
    flags: tuple[str, ...]
    """Of ``hvt-edge``, on top of clip, budget, detector and size."""
    says: str
    unlike: str = "M0"
    """A method that sends the very same bytes as this one does not have what it is named for."""
    fps_choices: tuple[float, ...] = ()
    """Fixed frame rates to fly; the best counts. None: as the flags say."""


METHODS: Mapping[str, MethodRow] = MappingProxyType(
    {
        row.name: row
        for row in (
            MethodRow("M0", (*_VIDEO_ONLY, *_BLIND), "video alone, 15 frames a second", unlike=""),
            MethodRow(
                "M0-fps",
                (*_VIDEO_ONLY, *_BLIND),
                "video alone at the fixed frame rate that shows most",
                unlike="",
                fps_choices=FPS_CHOICES,
            ),
            MethodRow("R0", (*_VIDEO_ONLY, "--roi-depth", "0.1"), "video that spends more on tracks"),
            MethodRow("M5-jpeg", ("--method", "M5", "--still-codec", "jpeg"), "video and JPEG stills"),
            MethodRow(
                "M5-residual",
                ("--method", "M5", "--still-codec", "residual"),
                "video and stills of what it lacks",
                unlike="M5-jpeg",
            ),
            MethodRow(
                "pulse", (*_VIDEO_ONLY, *_BLIND, "--pulse", "2s"), "a better whole frame every two seconds"
            ),
            MethodRow("rolling", (*_VIDEO_ONLY, "--rolling", "8x4"), "a better part of each frame, in turn"),
            MethodRow("tracks", (*_VIDEO_ONLY, *_SOURCE), "video, and what the edge sees in the source"),
            MethodRow(
                "M6",
                (
                    *("--method", "M6", "--still-codec", "residual", *_SOURCE),
                    *("--fps", "auto", "--video-share", "auto", "--borrow-unused", "--group-stills"),
                    *("--gate", "32", "--fidelity", "36", "--roi-depth", "0.1"),
                ),
                "all of it, as the rate and the scene allow",
                unlike="M5-residual",
            ),
        )
    }
)
"""By name, in the order of tables."""


def method_rows(names: str) -> tuple[MethodRow, ...]:
    """The rows of a list ``M0,R0,…``, in the table's order; `UserError` for a name that is not known, or none."""
    known = {name.casefold(): name for name in METHODS}
    wanted: set[str] = set()
    for word in names.split(","):
        name = known.get(word.strip().casefold())
        if name is None:
            raise UserError(f"--methods {word.strip()!r} is not known: choose from {','.join(METHODS)}")
        wanted.add(name)
    return tuple(row for name, row in METHODS.items() if name in wanted)
