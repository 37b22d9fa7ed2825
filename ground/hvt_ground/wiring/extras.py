"""Parts that need an extra package: only who asks for one needs it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hvt_common.errors import needs_extra
from hvt_ground.config import GroundConfig
from hvt_ground.events import Event
from hvt_ground.geolocation.surface import FLAT_GROUND, Surface
from hvt_ground.sinks import Outputs, SinkWriter
from hvt_ground.sinks.cot.reporter import SessionReporter
from hvt_ground.sinks.cot.type_table import read_types

if TYPE_CHECKING:
    from hvt_ground.sinks.mcap_file import McapFile

__all__ = ["check_cot", "make_cot", "make_surfaces", "mcap_file"]


def make_surfaces(terrain: Path | None) -> Callable[[str], Surface]:
    """What makes the ground of one flight, by the name of whose it is.

    The file is looked at once, here: `UserError` where it is no elevation model. One that goes later ends no flight.
    """
    if terrain is None:
        return lambda _flight: FLAT_GROUND
    with needs_extra("'hvt[terrain]'"):
        from hvt_ground.geolocation.elevation import ElevationModel  # noqa: PLC0415 - who has none needs no GDAL
        from hvt_ground.geolocation.terrain import Terrain  # noqa: PLC0415 - as above
    return partial(Terrain, ElevationModel(terrain))


def mcap_file() -> type[McapFile]:
    """The sink of ``--mcap``; `UserError` where its package is missing."""
    with needs_extra("'hvt[mcap]'"):
        from hvt_ground.sinks.mcap_file import McapFile  # noqa: PLC0415 - who writes none needs no protobuf
    return McapFile


def check_cot(config: GroundConfig) -> None:
    """Refuse types and certificates of ``--cot`` that cannot be used, before anything is received; `UserError`."""
    if config.cot:
        with needs_extra("'hvt[cot]'"):
            from hvt_ground.sinks.cot.connection import check_connection  # noqa: PLC0415 - who has none needs no pytak
        read_types(config.cot_types)
        for url in config.cot:
            check_connection(url)


def make_cot(config: GroundConfig, outputs: Outputs) -> Callable[..., SinkWriter[Event]] | None:
    """What makes the reporter of a session to all of ``--cot``; None without."""
    if not config.cot:
        return None
    check_cot(config)
    from hvt_ground.sinks.cot.connection import CotConnection  # noqa: PLC0415 - as above

    targets = [outputs.open(f"CoT {url}", partial(CotConnection, url)) for url in config.cot]
    return partial(SessionReporter, targets=targets, types=read_types(config.cot_types))
