"""``hvt-ground``: link to recording."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from hvt_common.config import load, to_toml
from hvt_common.errors import exit_with_sentence, needs_extra
from hvt_common.redaction import Redaction
from hvt_common.runtime.log import start_log
from hvt_common.runtime.plug_ins import extra_command
from hvt_common.runtime.process import (
    interrupt_on_signals,
    leave,
    limit_malloc_arenas,
    put_video_first,
    stop_on_signals,
)

_DESCRIPTION = """Receive what edges publish over Zenoh: decode, detect, track, refine classes by
the stills, and record all of it for the Rerun viewer.

Other commands, each with --help:
  hvt-ground doctor [SETTINGS]           what a ground with them needs, and lacks
  hvt-ground status                      how a ground that runs is
  hvt-ground recordings                  what a folder of recordings holds
  hvt-ground export FILE.rrd --to KIND   a recording as video, tables, pictures or MCAP
  hvt-ground replay FILE.hvtlog          receive again what --log kept, with other models
  hvt-ground still | tracks | keyframe   ask an edge, in flight
  hvt-ground set-budget | set-method     command it
  hvt-ground edges                       which edges are there
  hvt-ground keys                        make keys, and say who may do what"""
_BROUGHT = (
    *("doctor", "edges", "export", "keyframe", "keys", "recordings", "replay"),
    *("set-budget", "set-method", "status", "still", "tracks"),
)
"""Commands of the extras that come with HVT."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the ground; return 0, or after a sentence 2 (a setting is wrong) or 1 (it went wrong in flight)."""
    return exit_with_sentence(_run, program="hvt-ground", argv=argv)


def program() -> NoReturn:
    """`main` as a process of its own."""
    interrupt_on_signals()
    leave(main())


def _run(argv: Sequence[str] | None) -> int:
    words = sys.argv[1:] if argv is None else list(argv)
    if command := extra_command("ground", words, known=_BROUGHT):
        return command()
    from hvt_ground.extras import checked, config_class  # noqa: PLC0415

    config, requested = load(config_class(), argv, program="hvt-ground", description=_DESCRIPTION)
    redaction = Redaction([*words, *requested.values.values()])
    if requested.print_config:
        print(redaction.text(to_toml(config)), end="")
        return 0
    config = checked(config)
    with needs_extra("'hvt[ground]'"):  # only now: without Rerun this is a sentence, not a traceback
        from hvt_common.runtime.reporting import flown  # noqa: PLC0415
        from hvt_ground.app import Ground  # noqa: PLC0415
        from hvt_ground.sinks.rerun.sdk import leave_out_pandas  # noqa: PLC0415
    limit_malloc_arenas()
    put_video_first()
    leave_out_pandas()
    log = start_log("hvt-ground", quiet=config.quiet, form=config.log_format, redaction=redaction)
    stop = stop_on_signals()
    with log.ending():
        ground = Ground(config, stop=stop, on_started=log.release)
        flown(ground, stop, log=log, path=config.summary, show=_print)
    return 0


def _print(sessions: list[dict[str, Any]]) -> None:
    from hvt_common.runtime.reporting import print_table, say  # noqa: PLC0415
    from hvt_ground.report.status import table  # noqa: PLC0415

    for content in sessions:
        print_table(f"{content['edge']}: received", table(content))
    if not sessions:
        say("hvt-ground: no picture of an edge came")


if __name__ == "__main__":
    program()
