"""Several recordings as one that opens on their base pictures beside each other, each with a tab of its own.

``python -m hvt_archive.joined A.rrd B.rrd … --out ALL.rrd``: for flights of the same scene.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hvt_common.errors import UserError, exit_with_sentence, needs_extra
from hvt_common.runtime.reporting import check_writable
from hvt_common.units import parse_size

if TYPE_CHECKING:
    from rerun.chunk import Chunk

_FLUSH_S = 10.0


def join_recordings(paths: Sequence[Path], out: Path, *, base_size: tuple[int, int], fps: float) -> None:
    """Write the recordings of ``paths`` into ``out``, the entities of each below the name of its edge.

    Raises:
        UserError: a file is no recording, or two are of the same edge.
    """
    from hvt_ground.sinks.rerun.blueprint import comparison  # noqa: PLC0415 - they need Rerun
    from hvt_ground.sinks.rerun.sdk import (  # noqa: PLC0415
        RecordingId,
        new_recording,
        releasing_recordings,
        send_blueprint,
    )

    check_writable(out, name="--out", reads=paths)
    read = [_read(path) for path in paths]
    edges = [edge for edge, _ in read]
    if len(set(edges)) < len(edges):
        raise UserError(f"two recordings are of the same edge ({', '.join(edges)}): give one of each")
    name = RecordingId("joined", "-".join(edges))
    recording = new_recording(name)
    try:
        recording.save(out)
        recording.send_recording_name(", ".join(edges))
        send_blueprint(recording, name, comparison(edges, base_size=base_size, fps=fps))
        for edge, chunks in read:
            recording.send_chunks([one.with_entity_path(f"/{edge}{one.entity_path}") for one in chunks])
            recording.flush(timeout_sec=_FLUSH_S)
    finally:
        with releasing_recordings():
            recording.disconnect()
            del recording


def _read(path: Path) -> tuple[str, list[Chunk]]:
    # The edge's id, and everything but the file's own entities; of a damaged file its readable part.
    from hvt_archive.reading.readable import id_of  # noqa: PLC0415
    from hvt_archive.reading.recorded import readable_part  # noqa: PLC0415
    from hvt_ground.sinks.rerun.rrd_file import open_rrd  # noqa: PLC0415

    with readable_part(path, done="joined") as (found, _):
        reader = open_rrd(found)
        chunks = [one for one in reader.stream() if not one.entity_path.startswith("/__")]
        return id_of(reader).edge, chunks


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="hvt_archive.joined", description="Several recordings as one, beside each other."
    )
    parser.add_argument("recordings", type=Path, nargs="+", help=".rrd files, one an edge")
    parser.add_argument("--out", type=Path, required=True, help="the .rrd to write")
    parser.add_argument("--size", default="640x360", help="of the base streams (default 640x360)")
    parser.add_argument("--fps", type=float, default=15.0, help="of the frame timeline (default 15)")
    given = parser.parse_args(argv)
    size = parse_size(given.size, name="--size")
    with needs_extra("'hvt[ground]'"):
        join_recordings(given.recordings, given.out, base_size=size, fps=given.fps)
    return 0


if __name__ == "__main__":
    raise SystemExit(exit_with_sentence(main, program="hvt_archive.joined", argv=None))
