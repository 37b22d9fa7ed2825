"""The settings of tables that grow with a flight, and how the ground comes to write them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hvt_common.config import PATH, Group
from hvt_ground.config import GroundConfig, Written
from hvt_ground.extras import Extra, Flight, Opening, OpenSinks

if TYPE_CHECKING:  # ``--help`` is to open no table
    from hvt_archive.exports.tables import LineFile
    from hvt_ground.events import Event
    from hvt_ground.sinks import Outputs, Sink

_TABLES = Group("tables")


@dataclass(frozen=True)
class TableOptions(GroundConfig):
    """The settings of ``hvt-ground`` for them."""

    tracks: Path | None = _TABLES.option(
        PATH, None, "also write the tracks as a table: FILE.csv, or a folder for one file a session"
    )
    stills: Path | None = _TABLES.option(
        PATH, None, "also write each still as a picture, with a table of them: FILE.csv, or a folder"
    )
    timing: Path | None = replace(_TABLES, rare=True).option(
        PATH, None, "also write when each message was captured, sent, received and shown: FILE.csv"
    )


class TablesExtra(Extra[TableOptions]):
    """One of tracks and one of stills a session, one of times for all."""

    options = TableOptions

    def writes(self, config: TableOptions) -> Iterable[Written]:
        pictures = f"-{6 * '[0-9]'}*.png"
        for name, suffix, beside in (
            ("tracks", ".csv", ""),
            ("stills", ".csv", pictures),
            ("timing", "", ""),
        ):
            path = getattr(config, name)
            if path is not None:
                yield Written(f"--{name}", path, suffix, beside)

    def start(self, config: TableOptions, outputs: Outputs) -> OpenSinks:
        if config.tracks is config.stills is config.timing is None:
            return lambda _flight: ()
        from hvt_archive.exports.tables import (  # noqa: PLC0415
            SessionTiming,
            StillFiles,
            TrackTable,
            address_of,
        )

        times = None
        if config.timing is not None:
            times = outputs.open("timing table", partial(_open_times, config.timing, set()))

        def sinks(flight: Flight) -> Iterable[Opening | Sink[Event]]:
            edge, session_id = flight.info.edge, flight.info.session_id
            if config.tracks is not None:
                open_tracks = flight.new_file(config.tracks, ".csv", TrackTable)
                yield Opening(f"tracks table of {edge}", open_tracks)
            if config.stills is not None:
                open_stills = flight.new_file(config.stills, ".csv", StillFiles)
                yield Opening(f"stills of {edge}", open_stills, still_address=address_of)
            if times is not None:
                yield SessionTiming(times, edge=edge, session_id=session_id)

        return sinks


def _open_times(named: Path, taken: set[Path]) -> LineFile:
    from hvt_archive.exports.tables import timing_table  # noqa: PLC0415
    from hvt_ground.wiring.sessions import open_again  # noqa: PLC0415

    return open_again(named, taken, timing_table)
