"""hvt-ground that also writes when each message came: ``python timed_ground.py TIMING.csv [its own arguments]``.

The ground itself tells medians only, and a second subscriber beside it would take a share of the link. So this runs
the very same program with its two intakes of a session watched. One row a message:

kind,sequence,frame_index,capture_ns,send_ns,received_ns,shown_ns,line_bytes

``kind`` is base or roi, ``shown_ns`` is 0 for what could not be decoded or shown, times are Unix nanoseconds.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, TextIO

from hvt_common.link.ledger import overhead_bytes
from hvt_ground.cli import main
from hvt_ground.session import GroundSession

COLUMNS = "kind,sequence,frame_index,capture_ns,send_ns,received_ns,shown_ns,line_bytes"


def watch(file: TextIO) -> None:
    """From now on every session writes what it takes in."""
    file.write(COLUMNS + "\n")
    take_base, take_still = GroundSession.base, GroundSession.still

    def base(self: GroundSession, header: Any, item: Any, **how: Any) -> bool:
        good = take_base(self, header, item, **how)
        row("base", header, item, shown=good and how["decode"])
        return good

    def still(self: GroundSession, header: Any, item: Any, **how: Any) -> Any:
        answer = take_still(self, header, item, **how)
        row("roi", header, item, shown=True)
        return answer

    def row(kind: str, header: Any, item: Any, *, shown: bool) -> None:
        size, extra = len(item.payload), len(item.attachment)
        line = size + extra + overhead_bytes(size, extra, key=item.key, encoding=item.encoding)
        times = (header.capture_ns, header.send_ns, item.received_ns, time.time_ns() if shown else 0)
        file.write(",".join(map(str, (kind, header.sequence, header.frame_index, *times, line))) + "\n")
        file.flush()

    GroundSession.base, GroundSession.still = base, still  # type: ignore[method-assign,assignment]


def run(path: str, arguments: list[str], *, program: Callable[[list[str]], int] = main) -> int:
    """The ground with these arguments."""
    with open(path, "w", encoding="ascii") as file:  # noqa: PTH123 - as the ground would
        watch(file)
        return program(arguments)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1], sys.argv[2:]))
