"""``hvt-ground export FILE.rrd … --to KIND``: a recording for other programs, with capture times.

Video is copied, not coded again, unless boxes are drawn into it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from hvt_archive.exports.maps import write_geojson, write_kml
from hvt_archive.exports.pictures import write_coco, write_stills
from hvt_archive.exports.tables import write_csv, write_mot, write_parquet
from hvt_archive.exports.video import CONTAINERS, write_video
from hvt_archive.exports.whole import whole_file, whole_folder
from hvt_archive.reading.recorded import read_recordings
from hvt_common.errors import Parser, UserError, check_not_read
from hvt_common.runtime.reporting import say
from hvt_ground.extras import all_extras, locators
from hvt_ground.recordings.contract import Recorded
from hvt_ground.sinks.rerun.stills import still_of_event

_Write = Callable[[Recorded, Path], None]
_FOLDERS: dict[str, _Write] = {"coco": write_coco, "stills": write_stills}
_SUFFIXES = {"mot": ".txt"}
"""The suffixes other than the kind's own name."""
_FILES: dict[str, _Write] = {
    "csv": write_csv,
    "geojson": write_geojson,
    "kml": write_kml,
    "mot": write_mot,
    "parquet": write_parquet,
}


def _kinds(*, burn_in: bool = False) -> dict[str, _Write]:
    """The writer of each; those of extras take the place of a plain container, but where boxes are drawn."""
    plain: dict[str, _Write] = {
        kind: partial(write_video, container=kind, burn_in=burn_in) for kind in CONTAINERS
    }
    brought = {kind: write for extra in all_extras() for kind, write in extra.exports.items()}
    return plain | _FILES | brought | _FOLDERS | (plain if burn_in else {})


def run(argv: Sequence[str]) -> int:
    """Export; `UserError` where a file is no recording, or where there is no room."""
    given = _parser().parse_args(argv)
    kind = given.to or _kind_of(given.out)
    if given.burn_in and kind not in CONTAINERS:
        raise UserError(f"--burn-in draws into video, and --to is {kind}: give {', '.join(CONTAINERS)}")
    out = given.out or _beside(given.recordings[0], kind)
    reads = [*given.recordings, *([] if given.terrain is None else [given.terrain])]
    check_not_read(out, reads, name="--out")
    locator = locators(given.terrain)(given.recordings[0].name)
    recorded = read_recordings(given.recordings, locator=locator)
    with whole_folder(out) if kind in _FOLDERS else whole_file(out, new=given.out is None) as part:
        _kinds(burn_in=given.burn_in)[kind](recorded, part)
    stills = f"{len(recorded.stills)} stills{_missing_stills(recorded)}"
    say(f"{out}: {recorded.edge}, {len(recorded.video)} pictures, {stills}")
    return 0


def _missing_stills(recorded: Recorded) -> str:
    # Each that came has an event; a picture only as far as it was one and the recording had room.
    came = {still_of_event(one.text) for one in recorded.notices} - {None}
    missing = len(came) - len(recorded.stills)
    return f"; {missing} more came whose pictures the recording does not hold" if missing > 0 else ""


def _kind_of(out: Path | None) -> str:
    kind = "" if out is None else next((one for one in _kinds() if out.suffix == _suffix(one)), "")
    if not kind:
        raise UserError(f"--to is missing: give one of {', '.join(_kinds())}")
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
        choices=_kinds(),
        help=f"{', '.join(_kinds())} (default: by the end of --out)",
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
