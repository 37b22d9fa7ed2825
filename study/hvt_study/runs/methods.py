"""The methods of a study: each as settings of the edge, and how its bits are matched with the others'."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from hvt_common.errors import UserError

DDS = "DDS"
"""The server-driven peer (`hvt_study.peers.dds`)."""


class Kind(StrEnum):
    """The use that a method makes of the budget."""

    VIDEO = "video"
    """Spends everything on video: it is coded again for the total of each method that does not."""
    HYBRID = "hybrid"
    """Video and something beside it, by the edge's own choice."""
    PEER = "peer"
    """Somebody else's system, with an accounting of its own."""


@dataclass(frozen=True, slots=True)
class Method:
    """One method; nothing but its settings makes it differ from the others."""

    name: str
    kind: Kind
    says: str
    flags: tuple[str, ...] = ()
    """Flags of ``hvt-edge``, on top of clip, budget, detector, size and still codec."""
    sends_stills: bool = False
    """Whether ``--still-codecs`` multiplies it."""
    fps_choices: tuple[float, ...] = ()
    """Fixed frame rates of which the best counts; none: as the flags say."""
    any_size: bool = False
    """Whether the best size of the base stream counts, too (`hvt_study.runs.video_shape`)."""


_VIDEO = ("--method", "M0")
# Video alone needs no perception at the edge: it is not charged for it either.
_BLIND = (*_VIDEO, "--detect-every", "1000", "--camera-motion", "off")
_SOURCE = ("--candidates", "source", "--tiles", "auto", "--send-tracks")
_ADAPTIVE = (
    *("--method", "M6", *_SOURCE, "--fps", "auto", "--video-share", "auto", "--borrow-unused"),
    *("--group-stills", "--gate", "32", "--fidelity", "36", "--roi-depth", "0.1"),
)
_AUTO = (*_ADAPTIVE, "--profile", "auto")
_FPS_CHOICES = (15.0, 7.5, 5.0, 3.0, 2.0)


def _stills(name: str, says: str, flags: tuple[str, ...] = ()) -> Method:
    return Method(name, Kind.HYBRID, says, flags or ("--method", name), sends_stills=True)


_ALL = (
    Method("M0", Kind.VIDEO, "video alone, 15 frames a second", _BLIND),
    Method(
        "M0-fps",
        Kind.VIDEO,
        "video alone at the fixed frame rate that names most",
        _BLIND,
        fps_choices=(*_FPS_CHOICES, 1.0),
    ),
    Method(
        "M0-best",
        Kind.VIDEO,
        "video alone at the fixed frame rate and size that name most",
        _BLIND,
        fps_choices=(*_FPS_CHOICES, 1.0),
        any_size=True,
    ),
    Method("R0", Kind.VIDEO, "video that spends more on tracks", ("--method", "R0")),
    _stills("M1", "a still of each track every second, once it would gain"),
    _stills("M2", "a still when a track begins"),
    _stills("M3", "a still of tracks that are uncertain"),
    _stills("M4", "a still of tracks that are small"),
    _stills("M5", "most utility per byte"),
    _stills(
        "M6", "most expected gain per byte, with tracks, tiles, frame rate and split by measure", _ADAPTIVE
    ),
    Method(
        "auto",
        Kind.HYBRID,
        "M6 whose tracks and stills are sent while they pay",
        (*_AUTO, "--still-codec", "residual"),
    ),
    Method("tracks", Kind.HYBRID, "video, and what the edge detects in the source", (*_VIDEO, *_SOURCE)),
    _stills("permissive", "the pilot's selector of that name"),
    _stills("conf_size_top1", "the pilot's selector of that name"),
    _stills("strict_small_only", "the pilot's selector of that name"),
    _stills("balanced_top2", "the pilot's selector of that name"),
    Method(
        DDS,
        Kind.PEER,
        "two passes, the second where the ground asks (Du et al. 2020)",
        fps_choices=_FPS_CHOICES,
    ),
)
METHODS: Mapping[str, Method] = MappingProxyType({method.name: method for method in _ALL})


def chosen_methods(names: str) -> tuple[Method, ...]:
    """The methods of a list ``M0,R0,…``, in the table's order; `UserError` for a name that is not known."""
    return tuple(METHODS[name] for name in chosen_names(names, METHODS))


def chosen_names(text: str, known: Iterable[str], *, flag: str = "--methods") -> tuple[str, ...]:
    """Those of ``known`` that ``flag`` names, in that order; `UserError` for another name."""
    names = {name.casefold(): name for name in known}
    wanted: set[str] = set()
    for word in (part.strip() for part in text.split(",")):
        if word.casefold() not in names:
            raise UserError(f"{flag} {word!r} is not known: choose from {','.join(names.values())}")
        wanted.add(names[word.casefold()])
    return tuple(name for name in names.values() if name in wanted)
