"""``hvt-edge``: camera to link."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from hvt_common.config import load, to_toml
from hvt_common.errors import exit_with_sentence
from hvt_common.redaction import Redaction
from hvt_common.runtime.log import START_LOGGER, start_log
from hvt_common.runtime.plug_ins import extra_command
from hvt_common.runtime.process import (
    leave,
    limit_malloc_arenas,
    put_video_first,
    share_zenoh_threads,
    stop_on_signals,
)
from hvt_edge.config import EdgeConfig, check, note_on_share, with_profile

_BROUGHT = ("doctor", "status")
"""Commands of the extras that come with HVT."""
_DESCRIPTION = (
    "Publish a camera or clip over Zenoh: a low-bitrate HEVC base stream, and sharp stills of what matters, "
    "within a hard bit budget. hvt-edge doctor [SETTINGS] checks what a flight needs; hvt-edge status tells how "
    "one that runs with --metrics is."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the edge; return 0, 1 if no program received a picture of it, or 2 after a sentence on the fault."""
    return exit_with_sentence(_run, program="hvt-edge", argv=argv)


def program() -> NoReturn:
    """`main` as a process of its own."""
    leave(main())


def _run(argv: Sequence[str] | None) -> int:
    words = sys.argv[1:] if argv is None else list(argv)
    if command := extra_command("edge", words, known=_BROUGHT):
        limit_malloc_arenas()
        return command()
    config, given = load(EdgeConfig, argv, program="hvt-edge", description=_DESCRIPTION)
    config = with_profile(config, given=given.values)
    redaction = Redaction([*words, *given.values.values()])
    if given.print_config:
        print(redaction.text(to_toml(config)), end="")
        return 0
    config = check(config)
    from hvt_common.runtime.reporting import flown, print_table  # noqa: PLC0415
    from hvt_edge.app import Edge  # noqa: PLC0415
    from hvt_edge.report.status import in_vain, table, title  # noqa: PLC0415
    from hvt_edge.world import World  # noqa: PLC0415

    limit_malloc_arenas()
    put_video_first()
    share_zenoh_threads()
    world = World()
    log = start_log(
        "hvt-edge",
        quiet=config.quiet,
        form=config.log_format,
        redaction=redaction,
        edge=config.edge_id,
        session=f"{world.session_id:08x}",
    )
    if note := note_on_share(config, given=given.values):
        logging.getLogger(START_LOGGER).info("%s", note)
    stop = stop_on_signals()

    def show(content: dict[str, Any]) -> None:
        print_table(title(content), table(content))

    with log.ending():
        edge = Edge(config, stop=stop, on_started=log.release, world=world)
        content = flown(edge, stop, log=log, path=config.summary, show=show)
    return 1 if in_vain(content) else 0


if __name__ == "__main__":
    program()
