"""The ground side turns messages of edges into tracks, tables and recordings; `app.Ground` is all of it.

A program that wants the pictures, tracks and stills itself uses `listen`, see docs/library.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from hvt_library.ground import Listening

__all__ = ["listen"]


def listen(**settings: object) -> Listening:
    """A ground that gives its events to this program, with the settings of ``hvt-ground``.

    Raises `UserError` where a setting is unknown or wrong, or the extra is not installed.
    """
    from hvt_common.runtime.plug_ins import library_part  # noqa: PLC0415 - the ground itself needs no library

    return cast("Listening", library_part("ground", "listen")(**settings))
