"""The settings of MPEG-TS with KLV, and how the ground comes to write it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hvt_common.config import TEXT, Group
from hvt_common.errors import named_path
from hvt_ground.config import GroundConfig, Written
from hvt_ground.extras import Extra, Flight, Opening, OpenSinks

if TYPE_CHECKING:  # it opens PyAV, which settings alone do without
    from hvt_ground.recordings.row import Recorded
    from hvt_ground.sinks import Outputs


@dataclass(frozen=True)
class TransportStreamOptions(GroundConfig):
    """The settings of ``hvt-ground`` for it."""

    ts: str | None = Group("gateways", rare=True).option(
        TEXT,
        None,
        "also write MPEG-TS with KLV (docs/klv.md): FILE.ts, a folder for one file a session, udp://HOST:PORT or "
        "srt://HOST:PORT",
    )


def _export(recorded: Recorded, path: Path) -> None:
    from hvt_gateways.transport_stream.stream import write_recorded  # noqa: PLC0415

    write_recorded(recorded, path)


class TransportStreamExtra(Extra[TransportStreamOptions]):
    """A file or a live stream a session."""

    options = TransportStreamOptions
    exports = {"ts": _export}  # noqa: RUF012

    def writes(self, config: TransportStreamOptions) -> Iterable[Written]:
        if config.ts is not None and "://" not in config.ts:
            yield Written("--ts", named_path(config.ts, name="--ts"), ".ts")

    def check_outputs(self, config: TransportStreamOptions) -> None:
        """Refuse a destination that is none, or cannot be sent to."""
        if config.ts is not None:
            from hvt_gateways.transport_stream.destination import destination  # noqa: PLC0415

            destination(config.ts)

    def start(self, config: TransportStreamOptions, outputs: Outputs) -> OpenSinks:  # noqa: ARG002
        """Make the function that opens the stream of a session."""
        if config.ts is None:
            return lambda _flight: ()
        from hvt_gateways.transport_stream.destination import Addresses, destination  # noqa: PLC0415
        from hvt_gateways.transport_stream.stream import live_stream, stream_file  # noqa: PLC0415
        from hvt_gateways.transport_stream.uas import Platform  # noqa: PLC0415

        where, addresses = destination(config.ts), Addresses()

        def sinks(flight: Flight) -> Iterable[Opening]:
            info = flight.info
            platform = Platform(info.edge, f"{info.session_id:08x}", info.view, flight.locator)
            if isinstance(where, Path):
                opens = flight.new_file(where, ".ts", partial(stream_file, platform=platform, fps=info.fps))
            else:
                address = where.of_edge(info.edge)
                opens = partial(live_stream, address, platform=platform, fps=info.fps, addresses=addresses)
            yield Opening(f"MPEG-TS of {info.edge}", opens, longest_pause_s=5.0)

        return sinks
