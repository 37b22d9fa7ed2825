"""The ground side turns messages of edges into tracks, tables and recordings; `app.Ground` is all of it.

A program that wants the pictures, tracks and stills itself uses `listen`, see docs/library.md.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    """Load `listen`, of an extra, only when it is used."""
    if name == "listen":
        from hvt_common.runtime.plug_ins import library_part  # noqa: PLC0415

        return library_part("ground", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
