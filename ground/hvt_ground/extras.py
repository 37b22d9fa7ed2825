"""The door for extras: packages that bring settings, sinks, checks and kinds of export of their own.

An extra is an `Extra` that an entry point of the group ``hvt.ground`` names. It may use all of the
ground. The ground imports none, and runs the same where one is absent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, make_dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar, cast

from hvt_common.errors import not_installed
from hvt_common.runtime.plug_ins import installed, loaded
from hvt_ground.config import GroundConfig, Written, check

if TYPE_CHECKING:  # an extra brings settings, and ``--help`` is to open no recording
    from hvt_common.protocol.messages import Info
    from hvt_common.runtime.failures import Failures
    from hvt_common.runtime.reporting import Finding
    from hvt_common.transport.inbox import Received
    from hvt_ground.control import EdgeClient
    from hvt_ground.events import Event, Refinement
    from hvt_ground.poses import Locator
    from hvt_ground.recordings.row import Recorded, RecordingRow
    from hvt_ground.report.state import GroundState
    from hvt_ground.sinks import Outputs, Sink, SinkWriter
    from hvt_ground.sinks.rerun.recorder import RecorderSettings

Options = TypeVar("Options", bound=GroundConfig)

_GROUP = "hvt.ground"
_BRINGS = {
    "cot": ("cot", "cot-types"),
    "mcap": ("mcap",),
    "terrain": ("terrain",),
    "ground": ("ts", "keep", "keep-video", "log", "log-size", "tracks", "stills", "timing", "view", "serve"),
    "web": ("web", "web-proxy"),
}
_BROUGHT_BY = {setting: package for package, settings in _BRINGS.items() for setting in settings}
"""Settings of the extras that come with HVT, and the package to install for each."""

NewFile = Callable[[Path, str, "Callable[[Path], SinkWriter[Event]]"], "Callable[[], SinkWriter[Event]]"]
"""Opens a file, or one of the suffix in a folder, by a name that no other session of this ground has."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One session of an edge, for an extra's sinks."""

    info: Info
    locator: Locator
    """Gives its tracks places on the map."""
    recording: RecorderSettings
    """Of a recording of it, without a file."""
    clock: Callable[[], int]
    """The ground's steady clock, nanoseconds."""
    new_file: NewFile
    still_address: Callable[[Refinement], str]
    """Where the picture of a still can be seen; empty where nowhere."""


@dataclass(frozen=True, slots=True)
class Opening:
    """A sink to open: ``part`` names it in status and summary, as in "MCAP file of uav-1: disk full"."""

    part: str
    open: Callable[[], SinkWriter[Event]]
    waits: bool = True
    """Whether an edge in lockstep waits for it; one that sends to others does not hold it up."""
    longest_pause_s: float = 60.0
    """The longest pause after a failure before it is made again."""
    still_address: Callable[[Refinement, Path], str] | None = None
    """Where its newest file has the picture of a still; empty where it has none."""


OpenSinks = Callable[[Flight], "Iterable[Opening | Sink[Event]]"]
"""Sinks to open, and such as take each event at once, in any thread."""


def part_of(extra: object) -> str:
    """The name of an extra, or of its service, among the parts that fail."""
    return f"extra {type(extra).__module__.partition('.')[0]}"


class Service:
    """An extra's context around a whole run of a ground: it begins before the link opens and ends after it closes.

    After `begin` the exceptions of its methods are failures of its own.
    """

    links: Sequence[str] = ()
    """Where somebody can watch."""
    part: str = ""
    """The part that fails while the links lead nowhere yet."""
    shown_to_others: str = ""
    """Such a link that other machines reach, without secrets."""

    message_log: Callable[[Received], None] | None = None
    """Takes every message as it came, in any thread; set by `begin` where it wants them."""

    def begin(self, client: EdgeClient) -> None:
        """Nothing can be refused any more, the folder of ``--record`` is there, and ``client`` reaches the edges."""

    def sinks(self, flight: Flight) -> Iterable[Opening]:  # noqa: ARG002
        return ()

    def still_address(self, info: Info, still: Refinement) -> str:  # noqa: ARG002
        """Where the picture of a still can be seen; empty where nowhere."""
        return ""

    def show(self, state: GroundState) -> None:
        """Take how all edges are, once a second."""

    def recorded(self, row: RecordingRow) -> None:
        """Take the facts of a file of a recording: when it begins and ends, and every few seconds; in any thread."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""


class Extra(Generic[Options]):
    """The parts that an extra may bring; each method gets the whole configuration, an instance of ``options``."""

    options: ClassVar[type[GroundConfig]] = GroundConfig
    """A frozen dataclass without slots whose further fields are declared by `hvt_common.config.Group`."""
    exports: ClassVar[Mapping[str, Callable[[Recorded, Path], None]]] = {}
    """Kinds of ``hvt-ground export``, each with its writer: a file that ends in the kind's name."""

    def check(self, config: Options) -> None:
        """Raise `UserError` where its settings contradict each other or the ground's."""

    def reads(self, config: Options) -> Iterable[Path]:  # noqa: ARG002
        """The files that it reads: no output may be one of them."""
        return ()

    def writes(self, config: Options) -> Iterable[Written]:  # noqa: ARG002
        """Its output files; no addresses. The ground checks that they can be written, and makes folders."""
        return ()

    def check_outputs(self, config: Options) -> None:
        """Raise `UserError` if it could not send or make a requested output."""

    def checks(self, config: Options) -> Mapping[str, Callable[[], Finding]]:  # noqa: ARG002
        """Its checks in ``hvt-ground doctor``, by name."""
        return {}

    def serve(
        self,
        config: Options,  # noqa: ARG002
        *,
        clock: Callable[[], int],  # noqa: ARG002
        failures: Failures,  # noqa: ARG002
    ) -> Service | None:
        """Its `Service` for one whole run by the ground's ``clock``; `UserError` where it cannot start."""
        return None

    def start(self, config: Options, outputs: Outputs) -> OpenSinks:  # noqa: ARG002
        """Open the parts that all sessions share; return the function that opens the sinks of one, here none."""
        return lambda _flight: ()

    def locators(self, terrain: Path | None) -> Callable[[str], Locator] | None:  # noqa: ARG002
        """A maker of `Locator`s by the name of an edge, on an elevation model or flat ground; None without one."""
        return None


@cache
def all_extras() -> tuple[Extra[Any], ...]:
    """Those that are installed, by name; `UserError` where one does not load."""
    return tuple(
        cast("Extra[Any]", loaded(entry, lambda extra: extra(), what="extra"))
        for _, (entry, *_) in sorted(installed(_GROUP).items())
    )


def extras_of(config: GroundConfig) -> list[Extra[Any]]:
    return [extra for extra in all_extras() if isinstance(config, extra.options)]


@cache
def config_class(extras: tuple[Extra[Any], ...] | None = None) -> type[GroundConfig]:
    """`GroundConfig` with the settings of ``extras``, by default all; settings of absent ones are refused."""
    options = dict.fromkeys(extra.options for extra in (all_extras() if extras is None else extras))
    options.pop(GroundConfig, None)  # of an extra without settings
    whole = make_dataclass("GroundConfig", (), bases=(*options, GroundConfig), frozen=True)
    known = {field.name.replace("_", "-") for field in fields(whole)}
    absent = {name: package for name, package in _BROUGHT_BY.items() if name not in known}
    said = {name: str(not_installed("", f"hvt[{package}]")).lstrip() for name, package in absent.items()}
    whole.GONE = said  # type: ignore[attr-defined]
    return cast("type[GroundConfig]", whole)


def locators(terrain: Path | None) -> Callable[[str], Locator]:
    """A maker of `Locator`s by the name of an edge; `UserError` for an elevation model without the extra for it."""
    from hvt_ground.poses import NOWHERE  # noqa: PLC0415 - ``--help`` is to load no numpy

    for extra in all_extras():
        if (found := extra.locators(terrain)) is not None:
            return found
    if terrain is not None:
        raise not_installed("--terrain", f"hvt[{_BROUGHT_BY['terrain']}]")
    return lambda _flight: NOWHERE


def checked(config: GroundConfig) -> GroundConfig:
    """Return the configuration, `UserError` where settings contradict, those of extras too."""
    extras = extras_of(config)
    for extra in extras:
        extra.check(config)
    return check(config, more=_written_by(extras, config))


def written(config: GroundConfig) -> list[Written]:
    return [*config.written, *_written_by(extras_of(config), config)]


def _written_by(extras: Iterable[Extra[Any]], config: GroundConfig) -> list[Written]:
    return [one for extra in extras for one in extra.writes(config)]
