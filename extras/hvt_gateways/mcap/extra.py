"""The settings of MCAP, and how the ground comes to write it."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hvt_common.config import PATH, Group
from hvt_common.errors import needs_extra
from hvt_ground.config import GroundConfig, Written
from hvt_ground.extras import Extra, Flight, Opening, OpenSinks

if TYPE_CHECKING:
    from hvt_gateways.mcap.file import McapFile
    from hvt_ground.recordings.row import Recorded
    from hvt_ground.sinks import Outputs


@dataclass(frozen=True)
class McapOptions(GroundConfig):
    """The settings of ``hvt-ground`` for it."""

    mcap: Path | None = Group("gateways").option(
        PATH, None, "also write MCAP for Foxglove: FILE.mcap, or a folder for one file a session"
    )


class McapExtra(Extra[McapOptions]):
    """One file a session."""

    options = McapOptions

    def writes(self, config: McapOptions) -> Iterable[Written]:
        if config.mcap is not None:
            yield Written("--mcap", config.mcap, ".mcap")

    def start(self, config: McapOptions, outputs: Outputs) -> OpenSinks:  # noqa: ARG002
        target = config.mcap
        if target is None:
            return lambda _flight: ()
        file = _file()

        def sinks(flight: Flight) -> Iterable[Opening]:
            edge = flight.info.edge
            yield Opening(f"MCAP file of {edge}", flight.new_file(target, ".mcap", partial(file, edge=edge)))

        return sinks


def _export(recorded: Recorded, path: Path) -> None:
    with closing(_file()(path, edge=recorded.edge)) as file:
        for item in recorded.all():
            file.log(item)


McapExtra.exports = {"mcap": _export}


def _file() -> type[McapFile]:
    with needs_extra("'hvt[mcap]'"):
        from hvt_gateways.mcap.file import McapFile  # noqa: PLC0415 - who writes none needs no protobuf
    return McapFile
