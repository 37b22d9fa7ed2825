"""The contract of a source of poses."""

from __future__ import annotations

from typing import Protocol

from hvt_common.values import Pose


class PoseSource(Protocol):
    """Opened once; closed with the edge."""

    def at(self, media_ns: int, *, capture_ns: int) -> Pose | None:
        """The pose of a frame; None where it is not known. Quick: called in the frame loop.

        ``media_ns`` counts from the source's first frame, ``capture_ns`` is the frame's, and the pose's then.
        """
        ...

    @property
    def trouble(self) -> str:
        """Why there is none now; empty where there is one, or nobody would expect one."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """The guesses made at its opening, and their reasons: a sentence each."""
        ...

    def close(self) -> None:
        """Close open files and connections."""
        ...
