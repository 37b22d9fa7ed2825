"""The screen that a recording opens with, the names of its views, and their static styles and colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from hvt_ground.sinks.palette import AMBER, GREY, SKY, VERMILLION, WHITE, class_colour, dimmed
from hvt_ground.sinks.rerun.labels import LEGEND_POINTS, place_legend, points
from hvt_ground.sinks.rerun.overlays import BRIGHTNESS, LAYERS, REPORTED_MARK
from hvt_ground.sinks.rerun.still_places import CANVAS, SLOTS
from hvt_ground.sinks.rerun.tables import packed, static_chunk

BASE = "/base/"
"""With the name of a layer it is the place of its boxes."""
VIDEO = BASE + "video"
TRACKS, REPORTED, REFINED, DOUBTED, LABELS = (BASE + layer for layer in LAYERS)
LEGEND = BASE + "legend"
PATCHES = "/base/patches"
STILLS = "/stills"
OVERFLOW = "/stills/more"
STILL_MESSAGES = "/stills/messages"
BITRATE = "/link/bitrate"
LATENCY = "/link/latency"
TRACK_COUNT = "/link/tracks"
MAP_CAMERA = "/map/camera"
MAP_TRACKS = "/map/tracks"
EVENTS = "/events"
SESSION = "/session"

_BITRATE = (("total", WHITE, 1.5), ("base", SKY, 2.0), ("stills", AMBER, 2.0), ("budget", VERMILLION, 1.5))
_LATENCY = (("to receive", SKY, 2.0), ("to overlay", AMBER, 2.0))
_TRACKS = (("tracks", GREY, 2.0), ("refined", AMBER, 2.5))

_LEGEND = (
    f"□ seen on the base  ·  {REPORTED_MARK} reported only  ·  **thick** a still spoke  ·  "
    "hairline, **car?** doubted  ·  bright, ✓ above .9  ·  dark below .5"
)

_MAP_ZOOM = 18.0
"""Half a kilometre on a screen: about the view of a camera in the air."""
_PAPER = (14, 17, 22)
"""Background behind pictures."""


def screen(
    *,
    base_size: tuple[int, int],
    fps: float,
    budget_bps: float,
    clocked: bool,
    live: bool,
    located: bool = False,
) -> rrb.Blueprint:
    """Video with boxes, plots below; gallery of stills, session facts and events to the right.

    The video has a second tab: with the stills in their places, and boxes only of tracks that a still has spoken
    on. ``fps`` sets the pace of the frame timeline, ``budget_bps`` the height of the bitrate plot. Latencies are
    plotted where ``clocked``; ``live`` follows the newest data rather than play from the beginning; where
    ``located`` a third tab is the map.
    """
    top_kbps = 1.8 * budget_bps / 1000
    page = _page("", base_size=base_size, clocked=clocked, top_kbps=top_kbps, located=located)
    return _blueprint(page, fps=fps, live=live)


def comparison(edges: Sequence[str], *, base_size: tuple[int, int], fps: float) -> rrb.Blueprint:
    """The base pictures of several edges beside each other, their links below; then a tab with the page of each.

    The entities of each edge lie below its name.
    """
    columns = [
        rrb.Vertical(
            _video(base_size, edge, root=f"/{edge}", without=(f"{PATCHES}/**",)),
            _plot(f"/{edge}{BITRATE}", "Link, kbit/s"),
            row_shares=[1.6, 1.0],
        )
        for edge in edges
    ]
    beside = rrb.Horizontal(*columns, name="Side by side")
    pages = [_page(f"/{edge}", base_size=base_size, clocked=False, name=edge) for edge in edges]
    return _blueprint(rrb.Tabs(beside, *pages), fps=fps, live=False)


def static_chunks(title: str, facts: Mapping[str, str], *, info: bytes) -> list[Chunk]:
    """All static chunks of a recording whose session panel shows ``title`` and ``facts``; ``info`` is the message."""
    captioned = rr.Boxes2D.from_fields(radii=rr.Radius.ui_points(1.0), show_labels=True)
    message = [static_chunk(SESSION, rr.AnyValues(info=pa.array([info], pa.binary())))] if info else []
    return [
        *message,
        static_chunk(VIDEO, rr.VideoStream.from_fields(codec=rr.VideoCodec.H265)),
        static_chunk(TRACKS, _box_style(width=1.0, draw_order=10.0)),
        static_chunk(
            REPORTED,
            rr.Ellipses2D.from_fields(
                line_radii=rr.Radius.ui_points(0.5), draw_order=15.0, show_labels=False
            ),
        ),
        static_chunk(REFINED, _box_style(width=2.0, draw_order=20.0)),
        static_chunk(DOUBTED, _box_style(width=0.6, draw_order=12.0)),
        static_chunk(LABELS, _text_style(points=0.0)),
        static_chunk(LEGEND, _text_style(points=4.0)),
        *(static_chunk(f"{STILLS}/{slot}", captioned) for slot in range(SLOTS)),
        static_chunk(MAP_CAMERA, rr.GeoPoints.from_fields(radii=rr.Radius.ui_points(7.0), colors=AMBER)),
        static_chunk(MAP_TRACKS, rr.GeoPoints.from_fields(radii=rr.Radius.ui_points(4.0))),
        static_chunk(BITRATE, _lines(_BITRATE)),
        static_chunk(LATENCY, _lines(_LATENCY)),
        static_chunk(TRACK_COUNT, _lines(_TRACKS)),
        session_chunk(title, facts),
    ]


def session_chunk(title: str, facts: Mapping[str, str]) -> Chunk:
    """The session panel; the last one written holds."""
    reported = "  ·  ".join([f"**{title}**", *(f"{name} **{value}**" for name, value in facts.items())])
    text = f"{reported}\n\n{_LEGEND}"
    return static_chunk(SESSION, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def class_chunk(path: str, class_ids: Mapping[tuple[str, int], int]) -> Chunk:
    """Names and colours of classes at levels of `BRIGHTNESS` for the boxes of ``path``.

    Written again when a class is new; the last one holds for the whole recording, so ids must not change.
    """
    classes = [
        (number, ((number, name, packed(dimmed(class_colour(name), share=BRIGHTNESS[level]))), (), ()))
        for (name, level), number in class_ids.items()
    ]
    # In Arrow at once: the SDK's own way there imports Arrow's functions, 50 ms and 7 MB in a flight's first second.
    arrow_type = rr.components.AnnotationContextBatch._ARROW_DATATYPE  # noqa: SLF001
    return static_chunk(path, rr.AnnotationContext(pa.array([classes], arrow_type)))


def legend_chunk(class_names: Sequence[str], *, size: tuple[int, int]) -> Chunk:
    """The colours of classes, below a picture of this (width, height); the last one written holds."""
    return static_chunk(
        LEGEND,
        rr.Points2D.from_fields(
            positions=place_legend(class_names, size=size),
            labels=class_names,
            colors=[class_colour(name) for name in class_names],
        ),
    )


def _blueprint(content: rrb.Container, *, fps: float, live: bool) -> rrb.Blueprint:
    return rrb.Blueprint(
        content,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(
            state="collapsed",
            timeline="frame",
            fps=fps,
            play_state="following" if live else "playing",
            loop_mode="off" if live else "all",
        ),
        auto_layout=False,
        auto_views=False,
    )


def _page(
    root: str,
    *,
    base_size: tuple[int, int],
    clocked: bool,
    top_kbps: float | None = None,
    name: str | None = None,
    located: bool = False,
) -> rrb.Horizontal:
    plots = _plots(root, clocked=clocked, top_kbps=top_kbps)
    left = rrb.Vertical(_videos(root, base_size, located=located), plots, row_shares=[2.9, 1.0])
    session = rrb.TextDocumentView(origin=f"{root}{SESSION}", name="Session")
    right = rrb.Vertical(_gallery(root), session, _events(root), row_shares=[2.3, 0.67, 0.93])
    return rrb.Horizontal(left, right, column_shares=[1.72, 1.0], name=name)


def _videos(root: str, base_size: tuple[int, int], *, located: bool) -> rrb.Tabs:
    maps = [rrb.MapView(origin=f"{root}/map", name="Map", zoom=_MAP_ZOOM)] if located else []
    return rrb.Tabs(
        _video(base_size, "Base stream and tracks", root=root, without=(f"{PATCHES}/**",)),
        # Boxes say which objects a still has spoken on; thin and without words, for the picture is the matter.
        _video(
            base_size,
            "Enhanced: stills in their places",
            root=root,
            without=(TRACKS, REPORTED, DOUBTED, LABELS),
            bare=REFINED,
        ),
        *maps,
    )


def _video(
    base_size: tuple[int, int], name: str, *, root: str, without: tuple[str, ...], bare: str | None = None
) -> rrb.Spatial2DView:
    style = rr.Boxes2D.from_fields(radii=rr.Radius.ui_points(0.5), show_labels=False)
    return rrb.Spatial2DView(
        origin=f"{root}/base",
        contents=[f"{root}/base/**", *(f"- {root}{path}" for path in without)],
        name=name,
        background=_PAPER,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[0, base_size[0]], y_range=[0, base_size[1] + points(LEGEND_POINTS, base_size[0])]
        ),
        defaults=[rr.EncodedImage.from_fields(media_type="image/jpeg")],
        overrides={f"{root}{bare}": style.visualizer()} if bare is not None else None,
    )


def _gallery(root: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin=f"{root}{STILLS}",
        contents=[f"{root}{STILLS}/**", f"- {root}{OVERFLOW}/**"],
        name="Base crop | still",
        background=_PAPER,
        visual_bounds=rrb.VisualBounds2D(x_range=[0, CANVAS[0]], y_range=[0, CANVAS[1]]),
        defaults=[rr.EncodedImage.from_fields(media_type="image/jpeg")],
    )


def _plots(root: str, *, clocked: bool, top_kbps: float | None) -> rrb.Horizontal:
    # Nearly twice the budget: room for the legend, and an overshoot is seen to be one.
    axis = rrb.ScalarAxis(range=(0.0, top_kbps)) if top_kbps is not None else None
    plots = [_plot(f"{root}{BITRATE}", "Link, kbit/s", axis)]
    if clocked:
        plots.append(_plot(f"{root}{LATENCY}", "Latency, ms"))
    plots.append(_plot(f"{root}{TRACK_COUNT}", "Tracks"))
    return rrb.Horizontal(*plots, column_shares=[1.5, *[1.0] * (len(plots) - 1)])


def _plot(origin: str, name: str, axis_y: rrb.ScalarAxis | None = None) -> rrb.TimeSeriesView:
    corner = rrb.Corner2D.RightBottom if origin.endswith(TRACK_COUNT) else rrb.Corner2D.LeftTop
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=corner, axis_y=axis_y)


def _events(root: str) -> rrb.TextLogView:
    return rrb.TextLogView(
        origin=f"{root}{EVENTS}",
        name="Events",
        columns=rrb.TextLogColumns(timeline_columns=["frame"], text_log_columns=["body"]),
    )


def _box_style(*, width: float, draw_order: float) -> rr.Boxes2D:
    return rr.Boxes2D.from_fields(
        radii=rr.Radius.ui_points(width / 2), draw_order=draw_order, show_labels=False
    )


def _text_style(*, points: float) -> rr.Points2D:
    return rr.Points2D.from_fields(radii=rr.Radius.ui_points(points), draw_order=30.0, show_labels=True)


def _lines(lines: tuple[tuple[str, tuple[int, int, int], float], ...]) -> rr.SeriesLines:
    return rr.SeriesLines(
        names=[name for name, _, _ in lines],
        colors=[colour for _, colour, _ in lines],
        widths=[width for _, _, width in lines],
    )
