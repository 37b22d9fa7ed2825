"""What the study compares: each method as settings of the edge, and how its bits are matched with the others'."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from hvt_common.errors import UserError
from hvt_study.runs import compare_methods

__all__ = ["DDS", "METHODS", "Kind", "MatrixMethod", "chosen_methods"]

DDS = "DDS"
"""The server-driven peer (`hvt_study.peers.dds`)."""


class Kind(StrEnum):
    """What a method does with the budget."""

    VIDEO = "video"
    """Spends everything on video: it is coded again for the total of each method that does not."""
    HYBRID = "hybrid"
    """Video and something beside it, by the edge's own choice."""
    PEER = "peer"
    """Somebody else's system, with an accounting of its own."""


@dataclass(frozen=True, slots=True)
class MatrixMethod:
    """One method."""

    name: str
    kind: Kind
    says: str
    flags: tuple[str, ...] = ()
    """Of ``hvt-edge``, on top of clip, budget, detector, size and still codec."""
    sends_stills: bool = False
    """Whether ``--still-codecs`` multiplies it."""
    fps_choices: tuple[float, ...] = ()
    """Fixed frame rates of which the best counts; none: as the flags say."""


_SIGHT = compare_methods.METHODS
_FPS_CHOICES = (15.0, 7.5, 5.0, 3.0, 2.0)


def _video(name: str, *, fps_choices: tuple[float, ...] = ()) -> MatrixMethod:
    row = _SIGHT[name]
    says = "video alone at the fixed frame rate that names most" if fps_choices else row.says
    return MatrixMethod(name, Kind.VIDEO, says, row.flags, fps_choices=fps_choices)


def _stills(name: str, says: str) -> MatrixMethod:
    return MatrixMethod(name, Kind.HYBRID, says, ("--method", name), sends_stills=True)


def _without_codec(flags: tuple[str, ...]) -> tuple[str, ...]:
    at = flags.index("--still-codec")
    return flags[:at] + flags[at + 2 :]


METHODS: Mapping[str, MatrixMethod] = MappingProxyType(
    {
        row.name: row
        for row in (
            _video("M0"),
            _video("M0-fps", fps_choices=_FPS_CHOICES),
            _video("R0"),
            _video("pulse"),
            _video("rolling"),
            _stills("M1", "a still of each track every second"),
            _stills("M2", "a still when a track begins"),
            _stills("M3", "a still of tracks that are uncertain"),
            _stills("M4", "a still of tracks that are small"),
            _stills("M5", "most utility per byte"),
            MatrixMethod(
                "M6",
                Kind.HYBRID,
                "most expected gain per byte, with tracks, tiles, frame rate and split by measure",
                _without_codec(_SIGHT["M6"].flags),
                sends_stills=True,
            ),
            MatrixMethod("tracks", Kind.HYBRID, _SIGHT["tracks"].says, _SIGHT["tracks"].flags),
            _stills("permissive", "the pilot's selector of that name"),
            _stills("conf_size_top1", "the pilot's selector of that name"),
            _stills("strict_small_only", "the pilot's selector of that name"),
            _stills("balanced_top2", "the pilot's selector of that name"),
            MatrixMethod(
                DDS,
                Kind.PEER,
                "two passes, the second where the ground asks (Du et al. 2020)",
                fps_choices=_FPS_CHOICES,
            ),
        )
    }
)
"""By name, in the order of tables."""


def chosen_methods(names: str) -> tuple[MatrixMethod, ...]:
    """The methods of a list ``M0,R0,…``, in the table's order; `UserError` for a name that is not known."""
    known = {name.casefold(): name for name in METHODS}
    wanted: set[str] = set()
    for word in names.split(","):
        name = known.get(word.strip().casefold())
        if name is None:
            raise UserError(f"--methods {word.strip()!r} is not known: choose from {','.join(METHODS)}")
        wanted.add(name)
    return tuple(row for name, row in METHODS.items() if name in wanted)
