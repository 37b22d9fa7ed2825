"""The static data of a recording: codec, line colours, box styles, gallery frames, session facts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from hvt_ground.sinks.palette import (
    AMBER,
    BASE_LINE,
    BUDGET_LINE,
    GREY,
    STILL_LINE,
    TOTAL_LINE,
    class_colour,
    dimmed,
)
from hvt_ground.sinks.rerun import blueprint as names
from hvt_ground.sinks.rerun.labels import place_legend
from hvt_ground.sinks.rerun.overlays import BRIGHTNESS, REPORTED_MARK
from hvt_ground.sinks.rerun.stills.gallery import SLOTS
from hvt_ground.sinks.rerun.tables import static_chunk

_BITRATE = (
    ("total", TOTAL_LINE, 1.5),
    ("base", BASE_LINE, 2.0),
    ("stills", STILL_LINE, 2.0),
    ("budget", BUDGET_LINE, 1.5),
)
_LATENCY = (("to receive", BASE_LINE, 2.0), ("to overlay", STILL_LINE, 2.0))
_TRACKS = (("tracks", GREY, 2.0), ("refined", STILL_LINE, 2.5))

_LEGEND = (
    f"□ seen on the base  ·  {REPORTED_MARK} reported only  ·  **thick** a still spoke  ·  "
    "hairline, **car?** doubted  ·  bright, ✓ above .9  ·  dark below .5"
)


def static_chunks(title: str, facts: Mapping[str, str], *, info: bytes) -> list[Chunk]:
    """All static chunks of a recording whose session panel shows ``title`` and ``facts``; ``info`` is the message."""
    message = [static_chunk(names.SESSION, rr.AnyValues(info=pa.array([info], pa.binary())))] if info else []
    return [
        *message,
        static_chunk(names.VIDEO, rr.VideoStream.from_fields(codec=rr.VideoCodec.H265)),
        static_chunk(names.TRACKS, _box_style(width=1.0, draw_order=10.0)),
        static_chunk(names.REPORTED, _ellipse_style(width=1.0, draw_order=15.0)),
        static_chunk(names.REFINED, _box_style(width=2.0, draw_order=20.0)),
        static_chunk(names.DOUBTED, _box_style(width=0.6, draw_order=12.0)),
        static_chunk(names.LABELS, _text_style(points=0.0)),
        static_chunk(names.LEGEND, _text_style(points=4.0)),
        *(static_chunk(f"{names.STILLS}/{slot}", _caption_style()) for slot in range(SLOTS)),
        static_chunk(
            names.MAP_CAMERA, rr.GeoPoints.from_fields(radii=rr.Radius.ui_points(7.0), colors=AMBER)
        ),
        static_chunk(names.MAP_TRACKS, rr.GeoPoints.from_fields(radii=rr.Radius.ui_points(4.0))),
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


def class_chunk(path: str, class_ids: Mapping[tuple[str, int], int]) -> Chunk:
    """Names and colours of classes at levels of `BRIGHTNESS` for the boxes of ``path``.

    Written again when a class is new; the last one holds for the whole recording, so ids must not change.
    """
    return static_chunk(
        path,
        rr.AnnotationContext(
            [
                rr.AnnotationInfo(number, name, dimmed(class_colour(name), share=BRIGHTNESS[level]))
                for (name, level), number in class_ids.items()
            ]
        ),
    )


def legend_chunk(class_names: Sequence[str], *, size: tuple[int, int]) -> Chunk:
    """The colours of classes, below a picture of this (width, height); the last one written holds."""
    return static_chunk(
        names.LEGEND,
        rr.Points2D.from_fields(
            positions=place_legend(class_names, size=size),
            labels=class_names,
            colors=[class_colour(name) for name in class_names],
        ),
    )


def _box_style(*, width: float, draw_order: float) -> rr.Boxes2D:
    return rr.Boxes2D.from_fields(
        radii=rr.Radius.ui_points(width / 2), draw_order=draw_order, show_labels=False
    )


def _text_style(*, points: float) -> rr.Points2D:
    return rr.Points2D.from_fields(radii=rr.Radius.ui_points(points), draw_order=30.0, show_labels=True)


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
