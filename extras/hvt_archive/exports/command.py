"""``hvt-ground export FILE.rrd … --to KIND``: a recording for other programs, with capture times.

Video is copied, not coded again, unless boxes are drawn into it.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path

import av.error
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hvt_archive.exports.maps import write_geojson, write_kml
from hvt_archive.exports.pictures import write_coco, write_stills
from hvt_archive.exports.tables import TRACK_COLUMNS, plain_cells, track_rows
from hvt_archive.exports.video import CONTAINERS, write_video
from hvt_archive.reading.recorded import read_recordings
from hvt_common.errors import Parser, UserError, check_not_read
from hvt_common.files import claim_name
from hvt_common.runtime.reporting import say
from hvt_ground.extras import all_extras, locators
from hvt_ground.recordings.row import Recorded
from hvt_ground.sinks.rerun.stills import still_of_event

_BATCH_ROWS = 100_000
_TYPES = {
    "frame_index": pa.int64(),
    "capture_utc": pa.string(),
    "id": pa.int64(),
    **dict.fromkeys(("x", "y", "w", "h", "confidence"), pa.float32()),
    **dict.fromkeys(("base_class", "class", "origin"), pa.dictionary(pa.int32(), pa.string())),
    **dict.fromkeys(("refined", "late", "doubted"), pa.bool_()),
    **dict.fromkeys(("latitude", "longitude"), pa.float64()),
    "error_m": pa.float32(),
}


def write_csv(recorded: Recorded, path: Path) -> None:
    """One line a track and frame, the columns of `hvt_archive.exports.tables`."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(TRACK_COLUMNS)
        writer.writerows(map(plain_cells, _rows(recorded)))


def write_parquet(recorded: Recorded, path: Path) -> None:
    schema = pa.schema([(name, _TYPES[name]) for name in TRACK_COLUMNS])
    rows = _rows(recorded)
    # Not by its name: Arrow takes one in UTF-8 only.
    with path.open("wb") as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        while batch := list(islice(rows, _BATCH_ROWS)):
            writer.write_table(_table(batch, schema))


def _table(rows: Sequence[tuple[object, ...]], schema: pa.Schema) -> pa.Table:
    columns = []
    for field, column in zip(schema, zip(*rows, strict=True), strict=True):
        kind = field.type
        number = float if pa.types.is_floating(kind) else bool if pa.types.is_boolean(kind) else None
        values = column if number is None else [None if one == "" else number(one) for one in column]
        text = pa.types.is_dictionary(kind)
        columns.append(pa.array(values, pa.string()).cast(kind) if text else pa.array(values, kind))
    return pa.table(columns, schema=schema)


def write_mot(recorded: Recorded, path: Path) -> None:
    """``frame,id,x,y,w,h,confidence,-1,-1,-1``: frames and base pixels from 1 (MOTChallenge, Dendorfer et al., 2020).

    Tracks that stills doubt are left out: the format has no word for them.
    """
    with path.open("w", encoding="utf-8") as file:
        for overlay in recorded.overlays():
            for row in np.flatnonzero(~overlay.doubted).tolist():
                x1, y1, x2, y2 = overlay.boxes_base_px[row].tolist()
                box = f"{x1 + 1:.1f},{y1 + 1:.1f},{x2 - x1:.1f},{y2 - y1:.1f}"
                said = f"{overlay.track_ids[row]},{box},{overlay.confidences[row]:.3f}"
                file.write(f"{overlay.frame_index + 1},{said},-1,-1,-1\n")


def _rows(recorded: Recorded) -> Iterator[tuple[object, ...]]:
    for overlay in recorded.overlays():
        yield from track_rows(overlay)


@contextmanager
def whole_file(path: Path, *, new: bool = False) -> Iterator[Path]:
    """The name to write to; it takes the place of ``path`` at the end, and is removed where that fails.

    A link stays one: its target is replaced.

    Raises:
        UserError: it cannot be written, or is to be ``new`` and somebody has made one meanwhile.
    """
    path = Path(os.path.realpath(path)) if path.is_symlink() else path
    part = _part_of(path)
    if path.exists() and not path.is_file():  # moved over /dev/null, every program would fill the file
        raise UserError(f"{path} is there and no file: name a file with --out")
    try:
        yield part
        if new and not claim_name(path):
            raise UserError(f"{path} is there already: name another with --out")  # noqa: TRY301
        part.replace(path)
    except (OSError, av.error.FFmpegError) as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from error
    except UserError as error:
        raise UserError(str(error).replace(str(part), str(path))) from error
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """The same of a folder, which may be there if it is empty.

    Raises:
        UserError: it is not empty, or cannot be written.
    """
    part = _part_of(path)
    try:
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise UserError(f"{path} is there and not an empty folder: name one that is new")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        yield part
        if path.is_dir():
            path.rmdir()
        part.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _part_of(path: Path) -> Path:
    if not path.name:
        raise UserError(f"--out {path} has no name: name a file, or a folder that is new")
    return path.with_name(f".{path.name}.{os.getpid()}.part")  # another export may write the same


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
    # A folder such as ``.`` has no name, and is told of where it is read.
    out = recording.parent / f"{recording.stem}{f'.{kind}' if kind in _FOLDERS else _suffix(kind)}"
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
        "--to", metavar="KIND", choices=_kinds(), help=f"{', '.join(_kinds())} (default: by the end of --out)"
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
