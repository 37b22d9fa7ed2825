"""What a recording says once, for all times: codec, line colours, box styles, gallery frames, session facts."""

from __future__ import annotations

from collections.abc import Mapping

import rerun as rr
from rerun.chunk import Chunk

from hvt_ground.sinks.rerun import blueprint as names
from hvt_ground.sinks.rerun.gallery import SLOTS
from hvt_ground.sinks.rerun.overlays import REPORTED_MARK
from hvt_ground.sinks.rerun.palette import (
    BASE_LINE,
    BUDGET_LINE,
    GREY,
    STILL_LINE,
    TOTAL_LINE,
    class_colour,
    dimmed,
)
from hvt_ground.sinks.rerun.tables import static_chunk

__all__ = ["class_chunk", "session_chunk", "static_chunks"]

_BITRATE = (
    ("total", TOTAL_LINE, 1.5),
    ("base", BASE_LINE, 2.0),
    ("stills", STILL_LINE, 2.0),
    ("budget", BUDGET_LINE, 1.5),
)
_LATENCY = (("to receive", BASE_LINE, 2.0), ("to overlay", STILL_LINE, 2.0))
_TRACKS = (("tracks", GREY, 2.0), ("refined", STILL_LINE, 2.5))

_LEGEND = (
    f"□ seen on the base  ·  {REPORTED_MARK} reported by edge or still only  ·  "
    "**thick** a still spoke  ·  ✓ it agreed"
)


def static_chunks(title: str, facts: Mapping[str, str]) -> list[Chunk]:
    """All static chunks of a recording whose session panel shows ``title`` and ``facts``."""
    return [
        static_chunk(names.VIDEO, rr.VideoStream.from_fields(codec=rr.VideoCodec.H265)),
        static_chunk(names.TRACKS, _box_style(width=1.0, draw_order=10.0, labels=False)),
        static_chunk(names.REPORTED, _ellipse_style(width=1.0, draw_order=15.0)),
        static_chunk(names.REFINED, _box_style(width=2.5, draw_order=20.0, labels=True)),
        *(static_chunk(f"{names.STILLS}/{slot}", _caption_style()) for slot in range(SLOTS)),
        static_chunk(names.BITRATE, _lines(_BITRATE)),
        static_chunk(names.LATENCY, _lines(_LATENCY)),
        static_chunk(names.TRACK_COUNT, _lines(_TRACKS)),
        session_chunk(title, facts),
    ]


def session_chunk(title: str, facts: Mapping[str, str]) -> Chunk:
    """The session panel; the last one written holds."""
    return static_chunk(
        names.SESSION, rr.TextDocument(_facts(title, facts), media_type=rr.MediaType.MARKDOWN)
    )


def class_chunk(path: str, class_ids: Mapping[str, int], *, share: float) -> Chunk:
    """Names and colours of classes for the boxes of ``path``, at ``share`` of their brightness.

    Written again when a class is new; the last one holds for the whole recording, so ids must not change.
    """
    return static_chunk(
        path,
        rr.AnnotationContext(
            [
                rr.AnnotationInfo(number, name, dimmed(class_colour(name), share=share))
                for name, number in class_ids.items()
            ]
        ),
    )


def _box_style(*, width: float, draw_order: float, labels: bool) -> rr.Boxes2D:
    return rr.Boxes2D.from_fields(
        radii=rr.Radius.ui_points(width / 2), draw_order=draw_order, show_labels=labels
    )


def _ellipse_style(*, width: float, draw_order: float) -> rr.Ellipses2D:
    return rr.Ellipses2D.from_fields(
        line_radii=rr.Radius.ui_points(width / 2), draw_order=draw_order, show_labels=False
    )


def _caption_style() -> rr.Boxes2D:
    return rr.Boxes2D.from_fields(radii=rr.Radius.ui_points(1.0), show_labels=True)


def _lines(lines: tuple[tuple[str, tuple[int, int, int], float], ...]) -> rr.SeriesLines:
    return rr.SeriesLines(
        names=[name for name, _, _ in lines],
        colors=[colour for _, colour, _ in lines],
        widths=[width for _, _, width in lines],
    )


def _facts(title: str, facts: Mapping[str, str]) -> str:
    reported = "  ·  ".join([f"**{title}**", *(f"{name} **{value}**" for name, value in facts.items())])
    return f"{reported}\n\n{_LEGEND}"
