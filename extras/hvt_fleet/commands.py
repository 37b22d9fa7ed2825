"""``hvt-ground still | keyframe | tracks | edges | set-budget | set-method``: ask an edge from the command line."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from hvt_common.config import checked
from hvt_common.errors import Parser, UserError
from hvt_common.protocol.channels import EdgeKeys
from hvt_common.runtime.reporting import check_writable, say
from hvt_common.units import bitrate_text, parse_bitrate, parse_duration_s, shown_text
from hvt_ground.control import EdgeClient, RemoteEdge, RequestedStill, check_suffix

_TIMEOUT_S = 15.0


def run(argv: Sequence[str]) -> int:
    """Run one command; `UserError` where an edge refuses it or the user can mend something."""
    arguments = _parser().parse_args(argv)
    do = _prepare(arguments)
    if getattr(arguments, "edge", None) is not None:
        checked(EdgeKeys).parse(arguments.edge, name="--edge")
    with EdgeClient.connect(*arguments.connect, zenoh_config=arguments.zenoh_config) as edges:
        if arguments.command == "edges":
            names = edges.names()
            for name in names or [edges.nobody()]:
                print(shown_text(name))
            return 0
        do(edges[arguments.edge or _only_one(edges)])
    return 0


def _named(name: str, words: Sequence[str]) -> int:
    return run([name, *words])


def _only_one(edges: EdgeClient) -> str:
    names = edges.names()
    if len(names) == 1:
        return names[0]
    raise UserError(f"--edge is missing: there are {', '.join(names)}" if names else edges.nobody())


def _prepare(arguments: argparse.Namespace) -> Callable[[RemoteEdge], None]:
    # Prepare the command; all arguments are checked before any edge is queried.
    match arguments.command:
        case "still":
            return _still(arguments)
        case "tracks":
            return _tracks
        case "keyframe":
            return _keyframe
        case "set-budget":
            bps = parse_bitrate(arguments.rate, name="the budget")
            return lambda edge: _set_budget(edge, bps)
        case _:
            return lambda edge: _set_method(edge, arguments.method)


def _still(arguments: argparse.Namespace) -> Callable[[RemoteEdge], None]:
    box = None if arguments.box is None else _parse_box(arguments.box)
    at_s = None if arguments.at is None else -parse_duration_s(arguments.at.removeprefix("-"), name="--at")
    timeout_s = parse_duration_s(arguments.timeout, name="--timeout")
    out: Path = arguments.out
    check_suffix(out)
    check_writable(out, name="--out")

    def do(edge: RemoteEdge) -> None:
        still = edge.still(
            track=arguments.track,
            box=box,
            at_s=at_s,
            frame=arguments.frame,
            quality_pct=arguments.quality,
            timeout_s=timeout_s,
            on_note=lambda note: say(f"{edge.name}: {note}"),
        )
        still.save(out)
        say(f"{out}: {_described(still)}")

    return do


def _described(still: RequestedStill) -> str:
    header, (height, width) = still.header, still.image_bgr.shape[:2]
    x1, y1, x2, y2 = header.crop_source_px
    whose = f"track {header.track_id}, {header.class_name}" if header.track_id >= 0 else "box"
    shown = "" if (width, height) == (x2 - x1, y2 - y1) else f" shown at {width}x{height}"
    return (
        f"{whose}, frame {header.frame_index}, {x2 - x1}x{y2 - y1} pixels at {x1},{y1}{shown}; "
        f"{len(still.data)} bytes, {header.codec} q{header.quality_pct}"
    )


def _tracks(edge: RemoteEdge) -> None:
    tracks = edge.tracks(on_note=lambda note: print(shown_text(f"{edge.name}: {note}")))
    print(f"{'track':>6}  {'class':<14} {'conf':>4}  x,y,w,h in source pixels")
    for one in tracks:
        x1, y1, x2, y2 = one.box_source_px
        print(
            f"{one.track_id:>6}  {shown_text(one.class_name):<14} {one.confidence:>4.2f}  "
            f"{x1:.0f},{y1:.0f},{x2 - x1:.0f},{y2 - y1:.0f}"
        )


def _keyframe(edge: RemoteEdge) -> None:
    edge.keyframe()
    say(f"{edge.name}: a keyframe comes")


def _set_budget(edge: RemoteEdge, bps: int) -> None:
    edge.set_budget(bps)
    say(f"{edge.name}: {bitrate_text(bps)} from the next keyframe on, which comes now")


def _set_method(edge: RemoteEdge, method: str) -> None:
    edge.set_method(method)
    say(f"{edge.name}: method {method} from now on")


def _parse_box(text: str) -> tuple[int, int, int, int]:
    found = re.fullmatch(r"(\d{1,5}),(\d{1,5}),(\d{1,5}),(\d{1,5})", text)
    if found is None:
        raise UserError(
            f"--box {text!r} is not a box: write x,y,w,h in source pixels, for example 640,200,96,64"
        )
    x, y, w, h = map(int, found.groups())
    return x, y, w, h


COMMANDS = {
    "still": "a still of the untouched source frame, now or of some seconds ago",
    "tracks": "what an edge tracks now, by its own ids",
    "keyframe": "a keyframe",
    "set-budget": "another total budget",
    "set-method": "another method of choosing stills",
    "edges": "which edges are there",
}


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="hvt-ground", description=__doc__)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    made = {name: commands.add_parser(name, help=text, description=text) for name, text in COMMANDS.items()}
    for name, one in made.items():
        one.add_argument(
            "--connect",
            action="append",
            default=[],
            metavar="ENDPOINT",
            help="where a ground or a router listens [tcp/127.0.0.1:7447]",
        )
        one.add_argument(
            "--zenoh-config",
            type=Path,
            metavar="FILE",
            help="Zenoh configuration, with the keys where there are any",
        )
        if name != "edges":
            one.add_argument("--edge", metavar="NAME", help="which edge [the only one that is there]")
    _still_flags(made["still"])
    made["set-budget"].add_argument("rate", metavar="RATE", help="such as 600kbps")
    made["set-method"].add_argument("method", metavar="METHOD", help="such as M5; hvt-edge --help lists them")
    return parser


def _still_flags(parser: argparse.ArgumentParser) -> None:
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--track", type=int, metavar="N", help="the edge's id of a track; hvt-ground tracks lists them"
    )
    what.add_argument("--box", metavar="X,Y,W,H", help="source pixels [the whole frame]")
    when = parser.add_mutually_exclusive_group()
    when.add_argument("--at", metavar="TIME", help="so long before the newest frame, such as -3s [now]")
    when.add_argument(
        "--frame", type=int, metavar="N", help="or at this frame index, as the recording shows it"
    )
    parser.add_argument(
        "--quality",
        type=int,
        metavar="PCT",
        help="5 to 95; less where the budget is thin, more where the video is as good [the edge's]",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="crop.jpg or crop.png")
    parser.add_argument(
        "--timeout",
        default=f"{_TIMEOUT_S:g}s",
        metavar="TIME",
        help=f"how long to wait for it [{_TIMEOUT_S:g}s]",
    )


still, tracks, keyframe, set_budget, set_method, edges = (partial(_named, name) for name in COMMANDS)
"""Each is a command of ``hvt-ground``."""
