"""``hvt-ground export FILE.rrd … --to KIND``: a recording for other programs, with capture times.

Video is copied, not coded again, unless boxes are drawn into it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from hvt_common.errors import Parser, UserError, check_not_read, needs_extra
from hvt_common.runtime.reporting import say
from hvt_ground.exports.maps import write_geojson, write_kml
from hvt_ground.exports.pictures import write_coco, write_stills
from hvt_ground.exports.tables import write_csv, write_mot, write_parquet
from hvt_ground.exports.video import CONTAINERS, write_video
from hvt_ground.exports.whole import whole_file, whole_folder
from hvt_ground.recordings.recorded import Recorded, RecordedStill, read_recordings
from hvt_ground.wiring import make_surfaces

__all__ = ["run"]

_FOLDERS: dict[str, Callable[[Recorded, Path], None]] = {"coco": write_coco, "stills": write_stills}
_SUFFIXES = {"mot": ".txt"}
"""Where it is not the kind's own name."""


def _write_mcap(recorded: Recorded, path: Path) -> None:
    with needs_extra("'hvt[mcap]'"):
        from hvt_ground.sinks.mcap_file import McapFile  # noqa: PLC0415 - who writes none needs no protobuf
    file = McapFile(path, edge=recorded.edge)
    try:
        for item in recorded.all():
            if isinstance(item, RecordedStill):
                file.still(item.jpeg, frame_index=item.frame_index, capture_ns=item.capture_ns)
            else:
                file.log(item)
    finally:
        file.close()


_FILES: dict[str, Callable[[Recorded, Path], None]] = {
    "csv": write_csv,
    "geojson": write_geojson,
    "kml": write_kml,
    "mcap": _write_mcap,
    "mot": write_mot,
    "parquet": write_parquet,
}
_KINDS = (*CONTAINERS, *_FILES, *_FOLDERS)


def run(argv: Sequence[str]) -> int:
    """Export; `UserError` where a file is no recording, or where there is no room."""
    given = _parser().parse_args(argv)
    kind = given.to or _kind_of(given.out)
    if given.burn_in and kind not in CONTAINERS:
        raise UserError(f"--burn-in draws into video, and --to is {kind}: give {', '.join(CONTAINERS)}")
    out = given.out or _beside(given.recordings[0], kind)
    reads = [*given.recordings, *([] if given.terrain is None else [given.terrain])]
    check_not_read(out, reads, name="--out")
    surface = make_surfaces(given.terrain)(given.recordings[0].name)
    recorded = read_recordings(given.recordings, surface=surface)
    if kind in _FOLDERS:
        with whole_folder(out) as part:
            _FOLDERS[kind](recorded, part)
    else:
        write = (
            partial(write_video, container=kind, burn_in=given.burn_in)
            if kind in CONTAINERS
            else _FILES[kind]
        )
        with whole_file(out) as part:
            write(recorded, part)
    say(f"{out}: {recorded.edge}, {len(recorded.video)} pictures, {len(recorded.stills)} stills")
    return 0


def _kind_of(out: Path | None) -> str:
    kind = "" if out is None else next((one for one in _KINDS if out.suffix == _suffix(one)), "")
    if not kind:
        raise UserError(f"--to is missing: give one of {', '.join(_KINDS)}")
    return kind


def _beside(recording: Path, kind: str) -> Path:
    """The same name with another end, which nobody gave and which therefore must be free."""
    out = recording.with_suffix(f".{kind}" if kind in _FOLDERS else _suffix(kind))
    if out.exists():
        raise UserError(f"{out} is there already: name another with --out")
    return out


def _suffix(kind: str) -> str:
    return _SUFFIXES.get(kind, f".{kind}")


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="hvt-ground export", description=__doc__)
    parser.add_argument(
        "recordings", metavar="FILE.rrd", type=Path, nargs="+", help="the files of one session, in any order"
    )
    parser.add_argument(
        "--to",
        metavar="KIND",
        choices=_KINDS,
        help=f"{', '.join(_KINDS)} (default: by the end of --out)",
    )
    parser.add_argument(
        "--out",
        metavar="PATH",
        type=Path,
        help=f"the file, of {' and '.join(_FOLDERS)} the folder, to write (default: beside the recording)",
    )
    parser.add_argument(
        "--terrain",
        metavar="FILE.tif",
        type=Path,
        help="an elevation model that tracks stand on (default: flat)",
    )
    parser.add_argument("--burn-in", action="store_true", help="draw boxes, ids and classes into the video")
    return parser
