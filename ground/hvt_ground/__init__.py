"""The ground side turns messages of edges into tracks, tables and recordings; `app.Ground` is all of it.

A program that wants the pictures, tracks and stills itself uses `listen`, see docs/library.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hvt_ground.library import listen

__all__ = ["listen"]


def __getattr__(name: str) -> Any:
    """Only who uses it loads it."""
    if name == "listen":
        from hvt_ground.library import listen  # noqa: PLC0415

        return listen
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
