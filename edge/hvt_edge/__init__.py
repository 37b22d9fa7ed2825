"""The edge side, camera to link: `app.Edge` runs it, `wiring` builds its parts.

A program that has frames of its own uses `open`, see docs/library.md.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    """Load `open`, of an extra, only when it is used."""
    if name == "open":
        from hvt_common.runtime.plug_ins import library_part  # noqa: PLC0415

        return library_part("edge", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
