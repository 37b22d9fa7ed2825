"""Stills as refinement gets them."""

from __future__ import annotations

from hvt_common.values import Posterior
from hvt_ground.perception.stills.decode import Box
from hvt_ground.perception.stills.match import StillSeen
from rigs.examples import refinement


def seen(
    sequence: int,
    frame_index: int,
    posterior: Posterior,
    box: Box,
    *,
    edge: int,
    class_name: str = "car",
    side_px: float = 20.0,
) -> StillSeen:
    """A still of an edge track that was read."""
    event = refinement(
        frame_index=frame_index,
        capture_ns=frame_index * 66_666_667,
        still_sequence=sequence,
        track_id=None,
        edge_track_id=edge,
        box_base_px=box,
        still=f"still {sequence}".encode(),
        class_before=class_name,
        class_after=posterior.class_name,
        confidence=posterior.confidence,
        reason="uncertainty",
        shown_index=frame_index,
    )
    return StillSeen(event, posterior, side_px)
