"""The edge side, camera to link: `app.Edge` runs it, `wiring` builds its parts.

A program that has frames of its own uses `open`, see docs/library.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hvt_edge.library import open_edge as open  # noqa: A004 - of this package it is the first thing to do

__all__ = ["open"]


def __getattr__(name: str) -> Any:
    """Load `open` only when it is used."""
    if name == "open":
        from hvt_edge.library import open_edge  # noqa: PLC0415

        return open_edge
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
