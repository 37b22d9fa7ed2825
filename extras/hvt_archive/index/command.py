"""``hvt-ground recordings list | find``: lists recordings, and finds those with given contents."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from hvt_archive.index.database import read_index
from hvt_common.errors import Parser
from hvt_common.units import SECOND_NS, parse_age_s, shown_text, utc_text
from hvt_ground.recordings.row import RecordingRow

_HEAD = ("file", "edge", "begin (UTC)", "length", "MB", "frames", "stills", "tracks by class")


def run(argv: Sequence[str]) -> int:
    """Print the index's rows; `UserError` without an index."""
    arguments = _parser().parse_args(argv)
    wanted = _wanted(arguments) if arguments.command == "find" else lambda _: True
    known = read_index(arguments.folder)
    rows = [row for row in known if wanted(row)]
    if unread := sum(not (row.whole or wanted(row)) and arguments.edge in (None, row.edge) for row in known):
        said = f"files that are being written or are not read yet, and that may be of them: {unread}"
        print(f"hvt-ground recordings: {said}", file=sys.stderr)
    if arguments.json:
        print(json.dumps([_as_json(row, arguments.folder) for row in rows], indent=2))
        return 0
    table = [_HEAD, *map(_cells, rows)]
    widths = [max(len(line[column]) for line in table) for column in range(len(_HEAD))]
    lines = (
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in table
    )
    print(shown_text("\n".join(lines)))
    return 0


def _wanted(arguments: argparse.Namespace) -> Callable[[RecordingRow], bool]:
    since_ns = None if arguments.since is None else _since_ns(arguments.since, name="--since")
    until_ns = None if arguments.until is None else _since_ns(arguments.until, name="--until")

    def wanted(row: RecordingRow) -> bool:
        begin_ns, end_ns = row.begin_ns, row.end_ns
        return (
            (arguments.name is None or arguments.name in row.classes)
            and (arguments.edge is None or row.edge == arguments.edge)
            and (since_ns is None or (end_ns is not None and end_ns >= since_ns))
            and (until_ns is None or (begin_ns is not None and begin_ns <= until_ns))
        )

    return wanted


def _since_ns(text: str, *, name: str) -> int:
    # Unix time of ``2h`` ago, or of a date, UTC unless it says otherwise.
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        return time.time_ns() - round(parse_age_s(text, name=name, also=", or 2026-11-22T13:00") * SECOND_NS)
    return round((date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()) * SECOND_NS


def _cells(row: RecordingRow) -> tuple[str, ...]:
    lasted = ""
    if row.begin_ns is not None and row.end_ns is not None:
        minutes, seconds = divmod(round((row.end_ns - row.begin_ns) / SECOND_NS), 60)
        lasted = f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
    notes = [] if row.video else ["(video removed)"]
    notes += (
        []
        if row.whole
        else ["(being written, or its ground was killed)" if row.session else "(not read yet)"]
    )
    classes = ", ".join(f"{count} {name}" for name, count in row.classes.items())
    cells = (
        row.file,
        row.edge,
        _utc(row.begin_ns),
        lasted,
        f"{row.size_bytes / 1e6:.1f}",
        str(row.frames) if _counted(row) else "",
        str(row.stills) if _counted(row) else "",
        " ".join([classes, *notes]).strip(),
    )
    # Names come from the wire: none may move the cursor.
    return tuple(shown_text(cell).replace("\n", "?") for cell in cells)


def _as_json(row: RecordingRow, folder: Path) -> dict[str, object]:
    unknown = () if _counted(row) else ("frames", "stills", "classes")
    unread = () if row.session else ("session", "video")
    return (
        asdict(row)
        | dict.fromkeys((*unknown, *unread))
        | {
            "path": str(folder / row.file),
            "begin": _utc(row.begin_ns) or None,
            "end": _utc(row.end_ns) or None,
        }
    )


def _counted(row: RecordingRow) -> bool:
    # The row of a file that has just begun, or was not read yet, counts nothing.
    return bool(row.session) and (row.whole or row.begin_ns is not None)


def _utc(unix_ns: int | None) -> str:
    return "" if unix_ns is None else utc_text(unix_ns, milliseconds=False)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="hvt-ground recordings", description=__doc__)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    listing = commands.add_parser("list", help="all recordings of a folder")
    find = commands.add_parser("find", help="those of an edge, of a time, with a class")
    for one in (listing, find):
        one.add_argument("folder", metavar="FOLDER", type=Path, help="the folder that --record names")
        one.add_argument("--json", action="store_true", help="as JSON, with paths and times in nanoseconds")
    find.add_argument(
        "--class", dest="name", metavar="CLASS", help="a track was of this class, such as truck"
    )
    find.add_argument("--edge", metavar="ID", help="of this edge")
    find.add_argument("--since", metavar="TIME", help="not over before: 2h ago, or a date (UTC)")
    find.add_argument("--until", metavar="TIME", help="begun before")
    return parser
