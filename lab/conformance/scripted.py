"""Steps of tracks and reports of poses that no encoder makes: each number is given, in the order of the page."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from unittest.mock import patch

from hvt_common.protocol.messages import WireError, track_boxes
from hvt_common.protocol.messages.bits import BitWriter
from hvt_common.protocol.messages.range_coder import Context, Encoder, NumberContexts
from hvt_common.protocol.messages.track_boxes import CodedTrack

_FREE = {"MOST_BOXES": 1 << 20, "MOST_CLASSES": 1 << 20, "U32": 1 << 40, "_COARSEST": 20}
"""The limits that a step may break here, so that it is written to its end."""


class _Script(Encoder):
    """Writes the given numbers in place of those that it is called with; 0 once they are over."""

    def __init__(self, numbers: Iterable[int]) -> None:
        super().__init__()
        self._numbers = iter(numbers)
        self._inside = False

    def bit(self, context: Context, bit: int) -> int:
        return super().bit(context, bit if self._inside else next(self._numbers, 0))

    def unsigned(self, numbers: NumberContexts, value: int) -> int:
        return self._whole(super().unsigned, numbers, value)

    def signed(self, numbers: NumberContexts, value: int) -> int:
        return self._whole(super().signed, numbers, value)

    def _whole(self, write: object, numbers: NumberContexts, value: int) -> int:
        if self._inside:
            return write(numbers, value)  # type: ignore[operator, no-any-return]
        self._inside = True
        try:
            return write(numbers, next(self._numbers, 0))  # type: ignore[operator, no-any-return]
        finally:
            self._inside = False


def written(numbers: Iterable[int], *, reference: Sequence[CodedTrack] | None, frames: int) -> bytes:
    """A step's ``boxes`` on the list that the step before left."""
    coder = _Script(numbers)
    with ExitStack() as stack:
        for name, value in _FREE.items():
            stack.enter_context(patch.object(track_boxes, name, value))
        stack.enter_context(suppress(WireError))  # a scale below 0 ends the walk: zeros follow
        track_boxes._Walk(coder, frames).all(reference, None)
    return coder.finish()


Step = tuple[int, bool, Sequence[int]]
"""Frame, whether it builds on the step before, numbers."""


def track_sessions() -> Iterator[tuple[str, list[Step]]]:
    """By name; each step is written on the list that those before it left."""
    big = 2**30
    # Of a new track: id, class differs, confidence, scale and side of both axes, place, drift where it stands alone.
    plain = [0, 0, 0, 0, 0, 0, 0, 0, 0]
    alone = [*plain, 0, 0]
    yield (
        "what is held within its bounds",
        [
            (
                10,
                False,
                [
                    *(big, -big, 4),
                    *(0, 0, 100, 6, big, -5, -big, big, -big, -300, 0),
                    *(0, 0, -100, 0, -big, 11, big, -big, big, big, -big),
                    *(4, 1, 2047, 3, -6, 30, 0, -30, 500, -70, 3, -3),
                    *(0, 1, 0, -9, 0, 0, 0, 0, 4000, 4000, 0, big),
                ],
            ),
            (
                40,
                True,
                [1, 1, 1, 1, 3, -2, *(big, -big, big, -big, 1, 0, 100), *(-big, big, -big, big, 1, 0, -100)],
            ),
            (90, True, [0, 0, 1, 0, 0, 0, 9, -9]),
            (2000, True, [0, 0, 0, 0]),
            (2192, True, [1, 0, 0, 1, -1, 1, 0, 0, 0, 0, 0, 5, 5]),
        ],
    )
    yield (
        "missed, forgotten and born again",
        [
            (0, False, [0, 0, 2, 6, *alone[1:], 6, *alone[1:]]),
            *((frame, True, [0, 1]) for frame in range(5, 35, 5)),
            (40, True, [0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 6, *plain[1:]]),
            (45, True, [0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 6, *plain[1:]]),
            (50, True, [1, 1]),
        ],
    )
    yield (
        "not sorted, and the lower of two in the middle",
        [
            (0, False, [40, 8, 2, 9, *plain[1:], -9, 4, 9, *plain[1:], 8, -5]),
            (7, True, [1, 1, -1, -1, 5, 4, 0, 0, 0, 3, -3, 0, 0, 0, 1, 4, *plain[1:]]),
            (8, True, [1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 2, *plain[1:]]),
        ],
    )
    yield (
        "as many as may be",
        [
            (0, False, [0, 0, 2, *alone, *alone]),
            (3, True, [0, 0, 1023, 4]),
            (5, True, [0, 0, 1024, 4]),
            (6, True, [0, 0, 1025, 4]),
            (9, False, [0, 0, 1025]),
            (9, False, [0, 0, 1024]),
            (10, True, [*[1] * 1024, *[0] * (2 + 5 * 1024), 1, 1024]),
        ],
    )
    still = [1, 1, 0, 0]
    yield (
        "halves, nobody there, and a number as long as may be",
        [
            (
                0,
                False,
                [0, 0, 2, *(0, 0, 0, -5, 0, -5, 0, 50, 60, 1, 1), *(0, 0, 0, 0, 0, 0, 0, 500, 600, 0, 0)],
            ),
            (1, True, still),
            (4, True, [*still, *(0, 0, 0, 0, 0), *(2, 2, 0, 0, 0)]),
            (135, True, still),
            (136, True, [0, 0, 1, *(6, 0, 0, 0, 0, 0, 0, 2**32 + 5, -(2**32) - 5)]),
        ],
    )
    for what, born in (
        ("a class", [0, 1, 2048, *plain[2:], 0, 0]),
        ("an id", [2**32 - 1, *plain[1:], 0, 0]),
        ("a large scale", [0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0]),
        ("a large scale of the other axis", [0, 0, 0, 0, 0, 7, 0, 0, 0, 0, 0]),
        ("a small scale", [0, 0, 0, -6, 0, 0, 0, 0, 0, 0, 0]),
    ):
        good = [2**32 - 2, 1, 2047, 0, 6, 0, -5, 0, 0, 0, 0, 0]
        yield f"{what} that cannot be", [(0, False, [0, 0, 1, *born]), (1, False, [0, 0, 1, *good])]


def whole_pose(
    number: int,
    time_ms: int,
    place: Sequence[int],
    *,
    yaw: int | None = None,
    pitch: int = 0,
    roll: int = 0,
    field: int | None = None,
    height: int | None = None,
) -> BitWriter:
    """A report that stands by itself: place, the camera where it has a yaw, and so on, and errors of 4."""
    there = (height is not None) << 4 | (yaw is not None) << 2 | (field is not None)
    out = BitWriter().u(1, 1).u(number, 4).u(time_ms, 42).u(there, 5)
    out.u(place[0] + 900_000_000, 31).u(place[1] + 1_800_000_000, 32)
    if height is not None:
        out.u(height + 10_000, 20)
    if yaw is not None:
        out.u(yaw, 12).u(pitch + 900, 11).u(roll + 1800, 12)
    if field is not None:
        out.u(field - 1, 11)
    return out.u(4, 5).u(4, 5).u(4, 5)


def pose_changes(
    number: int,
    *,
    time_ms: int = 1000,
    place: Sequence[int] = (0, 0),
    camera: Sequence[int] = (),
    errors: int = 0,
    height: int | None = None,
) -> BitWriter:
    """A report that builds on the one before; ``time_ms`` later."""
    out = BitWriter().u(0, 1).u(number, 4).se(time_ms - 1000, 4)
    for change in place:
        out.se(change, 5)
    if height is not None:
        out.se(height, 2)
    for change in camera:
        out.se(change, 3)
    for _ in range(3):
        out.se(errors, 0)
    return out
