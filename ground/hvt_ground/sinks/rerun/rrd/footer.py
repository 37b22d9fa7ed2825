"""Complete a recording with the footer that ``rerun rrd verify`` and random access ask for."""

from __future__ import annotations

import logging
import subprocess
from pathlib import Path

from hvt_ground.sinks.rerun.live_view import viewer_environment, viewer_program

__all__ = ["add_footer"]

_log = logging.getLogger(__name__)

_LARGEST_BYTES = 64 * 2**20
"""About ten minutes at 800 kbps. The tool holds the file in memory, and Ctrl-C is answered within three seconds; a
larger recording opens without a footer just as well."""
_PATIENCE_S = 2.0
_MOST_GROWTH = 1.12
"""A footer takes some 70 kB, whatever the length of the flight: too much for one of a few seconds."""


def add_footer(path: Path) -> bool:
    """Rewrite the file with a footer, whole or not at all; False where that was not done.

    The SDK's own program does it (60 ms for 1.3 MB); it also gathers the video's chunks by keyframe.
    """
    if path.stat().st_size > _LARGEST_BYTES:
        return False
    scratch = path.with_name(path.name + ".part")
    command = [str(viewer_program()), "rrd", "optimize", str(path), "-o", str(scratch)]
    try:
        subprocess.run(  # noqa: S603 - the SDK's own program, no shell
            command, env=viewer_environment(), capture_output=True, check=True, timeout=_PATIENCE_S
        )
        if scratch.stat().st_size > _MOST_GROWTH * path.stat().st_size:
            scratch.unlink()
            return False
        scratch.replace(path)
    except (OSError, subprocess.SubprocessError) as error:
        _log.info("%s stays without a footer: %s", path, error)
        scratch.unlink(missing_ok=True)
        return False
    return True
