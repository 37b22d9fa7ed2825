"""Small objects that stand close together share one still where that takes fewer bytes.

A still costs its pixels and, whatever it shows, a fixed part: what the codec writes first, the header, framing and
TCP. A crop around two neighbours codes the ground between them as well, and saves one fixed part. Whether that pays
follows from the codec's own costs as they were learnt in this session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hvt_common.video.base_crop import MAX_SIDE_PX, coded_size
from hvt_edge.perception.candidates import crop_box
from hvt_edge.stills.policy.base import CostEstimate, Request

ALSO_BYTES = 17.0
"""Bytes of the header for each further track: its id and its box in eighths of a pixel."""
MOST_ALSO = 15
_MOST_COMPARED = 96
"""Of more requests only the most useful are compared with each other, which bounds the time."""
_LEAST_SAVING_BYTES = 1.0


def group(
    requests: Sequence[Request],
    *,
    cost: CostEstimate,
    overhead_bytes: float,
    padding: float,
    source_size: tuple[int, int],
    most: int = MOST_ALSO,
    max_side_px: int = MAX_SIDE_PX,
) -> list[tuple[Request, list[Request]]]:
    """Join the requests of one step into stills: each with its lead and the others that the same still shows.

    The two stills that save most by becoming one are joined, and again, until no two save a byte; no still
    shows more than ``most`` tracks beside its lead, nor a side of more than ``max_side_px`` where it shows several.
    ``overhead_bytes`` is what a still takes on the line beside its payload.

    The lead is the most useful of its group and comes with ``also`` filled and a score of its own: what all of them
    gain over what the one still costs, if scores are gains per byte; never less than its score alone. Most wanted
    first, ties by the lead's track id. Each request is in exactly one group.
    """
    compared = list(requests[:_MOST_COMPARED])
    crops = [
        crop_box(one.candidate.box_source_px, padding=padding, source_size=source_size) for one in compared
    ]
    single = np.array([cost.of(one.candidate) + overhead_bytes for one in compared], np.float64)
    board = _Board(
        cost=cost,
        overhead_bytes=overhead_bytes,
        most=most,
        max_side_px=max_side_px,
        crops=np.array(crops, np.int64).reshape(-1, 4),
        bytes=single.copy(),
        single_bytes=single,
        members=[[index] for index in range(len(compared))],
    )
    board.join()
    joined = [board.request(members, compared) for members in board.groups()]
    joined += [(one, []) for one in requests[_MOST_COMPARED:]]
    return sorted(joined, key=lambda one: (-one[0].score, one[0].candidate.track_id))


def union_crop(
    request: Request, *, padding: float, source_size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The area of a still of it: the smallest box around the padded crops of all its tracks, source pixels."""
    crops = [
        crop_box(one.box_source_px, padding=padding, source_size=source_size)
        for one in (request.candidate, *request.also)
    ]
    x1, y1, x2, y2 = zip(*crops, strict=True)
    return min(x1), min(y1), max(x2), max(y2)


def expected_bytes(
    request: Request, *, cost: CostEstimate, padding: float, source_size: tuple[int, int]
) -> float:
    """Expected payload of a still of this request, of one track or of several."""
    if not request.also:
        return cost.of(request.candidate)
    width, height = coded_size(union_crop(request, padding=padding, source_size=source_size))
    return cost.of_px(width * height)


@dataclass(slots=True)
class _Board:
    # Stills under way: row ``i`` is the still that request ``i`` leads, until another takes it in.

    cost: CostEstimate
    overhead_bytes: float
    most: int
    max_side_px: int
    crops: npt.NDArray[np.int64]
    """(N, 4) source pixels."""
    bytes: npt.NDArray[np.float64]
    """(N,) expected line bytes."""
    single_bytes: npt.NDArray[np.float64]
    members: list[list[int]]
    """Empty where another has taken the still in."""

    def join(self) -> None:
        count = len(self.members)
        savings = np.full((count, count), -np.inf)
        for row in range(count):
            savings[row, row + 1 :] = self._savings(row)[row + 1 :]
        while count:
            # Of equal savings the first: the same requests give the same stills in every run.
            lead, other = divmod(int(savings.argmax()), count)
            if savings[lead, other] < _LEAST_SAVING_BYTES:
                return
            self._take_in(lead, other)
            savings[other, :] = savings[:, other] = -np.inf
            fresh = self._savings(lead)
            savings[lead, lead + 1 :] = fresh[lead + 1 :]
            savings[:lead, lead] = fresh[:lead]

    def groups(self) -> list[list[int]]:
        """The requests of each still, most useful first."""
        return [sorted(members) for members in self.members if members]

    def request(self, members: list[int], requests: Sequence[Request]) -> tuple[Request, list[Request]]:
        """One still's request, and those that ride with it."""
        lead, others = requests[members[0]], [requests[index] for index in members[1:]]
        if not others:
            return lead, []
        gain = sum(requests[index].score * self.single_bytes[index] for index in members)
        also = tuple(sorted((one.candidate for one in others), key=lambda one: one.track_id))
        score = max(lead.score, float(gain / self.bytes[members[0]]))
        return replace(lead, also=also, score=score), others

    def _savings(self, row: int) -> npt.NDArray[np.float64]:
        # (N,) line bytes saved by joining this still with each other one; -inf where that may not be.
        low = np.minimum(self.crops[:, :2], self.crops[row, :2])
        high = np.maximum(self.crops[:, 2:], self.crops[row, 2:])
        sides = high - low
        tracks = np.array([len(members) for members in self.members], np.int64)
        together = tracks + tracks[row]
        union = self._line_bytes(sides.prod(axis=1), together)
        savings = np.asarray(self.bytes + self.bytes[row] - union, np.float64)
        savings[(sides.max(axis=1) > self.max_side_px) | (together > self.most + 1) | (tracks == 0)] = -np.inf
        savings[row] = -np.inf
        return savings

    def _line_bytes(
        self, coded_px: npt.NDArray[np.int64], tracks: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        payload = np.maximum(1.0, self.cost.fixed_bytes + self.cost.bytes_per_px * coded_px)
        return np.asarray(payload + self.overhead_bytes + ALSO_BYTES * (tracks - 1), np.float64)

    def _take_in(self, lead: int, other: int) -> None:
        self.crops[lead, :2] = np.minimum(self.crops[lead, :2], self.crops[other, :2])
        self.crops[lead, 2:] = np.maximum(self.crops[lead, 2:], self.crops[other, 2:])
        self.members[lead] += self.members[other]
        self.members[other] = []
        px = self.crops[lead, 2:] - self.crops[lead, :2]
        self.bytes[lead] = self._line_bytes(
            px.prod(keepdims=True), np.array([len(self.members[lead])], np.int64)
        )[0]
