"""The edge side, camera to link: `app.Edge` runs it, `wiring` builds its parts.

A program that has frames of its own uses `open`, see docs/library.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from hvt_library.edge import PushedEdge

__all__ = ["open"]


def open(**settings: object) -> PushedEdge:  # noqa: A001 - of this package it is the first thing to do
    """An edge that takes its frames from this program, with the settings of ``hvt-edge``.

    Raises `UserError` where a setting is unknown or wrong, or the extra is not installed.
    """
    from hvt_common.runtime.plug_ins import library_part  # noqa: PLC0415 - the edge itself needs no library

    return cast("PushedEdge", library_part("edge", "open")(**settings))
