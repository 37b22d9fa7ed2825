"""Text of a user, a file or a model's metadata: command lines, TOML, Zenoh configurations, rosters, manifests."""

import contextlib
import io
from collections.abc import Callable
from pathlib import Path

from hvt_common import config, units
from hvt_common.errors import UserError
from hvt_common.inference.labels import metadata_labels, read_labels
from hvt_common.protocol.channels import check_edge_pattern, matches
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_edge.config import EdgeConfig
from hvt_edge.config import check as check_edge
from hvt_fleet.pki.roster import GroundMember, Roster, RouterMember
from hvt_ground.config import GroundConfig
from hvt_models.manifest import parse_manifest
from lab.fuzz.contract import Target, scratch


def _file(data: bytes, name: str) -> Path:
    path = scratch() / name
    path.write_bytes(data)
    return path


def _text(data: bytes) -> str:
    return data.decode("utf-8", "surrogateescape")


def _units(data: bytes) -> None:
    text = _text(data)
    for parse in (
        units.parse_bitrate,
        units.parse_bytes,
        units.parse_duration_s,
        units.parse_size,
        units.parse_share,
    ):
        with contextlib.suppress(UserError):
            parse(text, name="--setting")
    with contextlib.suppress(UserError):
        matches("uav-1", edges=check_edge_pattern(text))


def _command_line(config_class: type, check: Callable[[object], object]) -> Callable[[bytes], None]:
    """Arguments, divided by zero bytes as a shell hands them on."""

    def run(data: bytes) -> None:
        argv = _text(data).split("\0")
        said = io.StringIO()
        # --help and --version end with 0; every other way out is a sentence.
        with contextlib.suppress(UserError), contextlib.redirect_stdout(said):
            try:
                settings, _ = config.load(config_class, argv, program="p", description="d")
            except SystemExit as end:
                assert end.code in (0, None), said.getvalue()  # noqa: PT017
                return
            check(settings)
            config.to_toml(settings)

    return run


def _toml(data: bytes) -> None:
    path = _file(data, "settings.toml")
    for config_class in (EdgeConfig, GroundConfig):
        with contextlib.suppress(UserError):
            config.load(config_class, ["--config", str(path)], program="p", description="d")


def _zenoh(data: bytes) -> None:
    path = _file(data, "zenoh.json5")
    with contextlib.suppress(UserError):
        configure(LinkSettings("ground", zenoh_config=path))


def _endpoint(data: bytes) -> None:
    with contextlib.suppress(UserError):
        configure(LinkSettings("edge", connect=(_text(data),)))


def _roster(data: bytes) -> None:
    _file(data, "fleet.json")
    with contextlib.suppress(UserError):
        roster = Roster.read(scratch())
        roster.with_edge("uav-1")


def _roster_seed() -> bytes:
    roster = Roster(
        edges=("uav-1", "uav-2"),
        grounds=(GroundMember("ground", ("192.0.2.1",), edges="uav-*"),),
        routers=(RouterMember("hub", ("hub.example",)),),
    )
    roster.write(scratch())
    return (scratch() / "fleet.json").read_bytes()


def _manifest(data: bytes) -> None:
    with contextlib.suppress(UserError):
        parse_manifest(_text(data), origin="added.toml")


_MANIFEST = b"""[net-1]
size_bytes = 1000
sha256 = "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef"
urls = ["https://[::1]:80/a.onnx", "http://example.org/a"]
task = "detector"
preprocessing = { channels = "bgr", mean = [0, 0, 0], scale = 1.0 }
"""


def _labels(data: bytes) -> None:
    names = metadata_labels({"names": _text(data), "classes": _text(data)})
    assert names is None or all(isinstance(name, str) for name in names)
    with contextlib.suppress(UserError):
        read_labels(_file(data, "names.txt"))


_ZENOH = (
    b'{mode: "peer", listen: {endpoints: ["tcp/127.0.0.1:7447"]}, transport: {link: {tls: {enable_mtls: true}}}}',
    b'{connect: {endpoints: {peer: ["tls/[::1]:7447#so_sndbuf=8192"]}}, // hub\n timestamping: {enabled: true}}',
)
_EDGE_LINES = (
    b"--source\0demo\0--budget\0800kbps\0--size\0640x360\0--method\0M6",
    b"--source\0a.mp4\0--fps\0auto\0--tiles\0auto\0--roi-depth\0000.1\0--ring-time\0001s",
    b"--connect\0tcp/127.0.0.1:7447\0--edge-id\0uav-1\0--video-share\00081%",
)
_GROUND_LINES = (
    b"--listen\0tcp/127.0.0.1:7447\0--edges\0uav-*\0--once",
    b"--detector\0motion\0--classifier\0none\0--record\0a.rrd",
)
_EDGE = _command_line(EdgeConfig, check_edge)
_GROUND = _command_line(GroundConfig, lambda _settings: None)
_UNITS = (b"800kbps", b"0.8 Mbit/s", b"200MB", b"2.5s", b"1280x720", b"81.25%", b"uav-*")
_SETTINGS = (
    b'budget = "800kbps"\nsize = "640x360"\nconnect = ["tcp/127.0.0.1:7447"]\n',
    b"once = true\n",
)
_ENDPOINTS = (b"tcp/127.0.0.1:7447", b"tls/[::1]:1?a=b#c=d")
_NAMES = (b"{0: 'car', 1: 'bus'}", b'["car", "bus"]', b"car\nbus\n", b"((1, 2), {3: -4})")

TARGETS = (
    Target("units", _units, lambda: _UNITS, share=50, most_bytes=400),
    Target("edge-command-line", _EDGE, lambda: _EDGE_LINES, share=10, short=250, most_bytes=600),
    Target("ground-command-line", _GROUND, lambda: _GROUND_LINES, share=10, short=250, most_bytes=600),
    Target("settings-file", _toml, lambda: _SETTINGS, share=10, short=200, most_bytes=1000),
    Target("zenoh-file", _zenoh, lambda: _ZENOH, share=8, short=200, most_bytes=1000),
    Target("endpoint", _endpoint, lambda: _ENDPOINTS, share=8, short=800, most_bytes=300),
    Target("roster", _roster, lambda: [_roster_seed()], share=30, short=800, most_bytes=1000),
    Target("manifest", _manifest, lambda: [_MANIFEST], share=30, most_bytes=1000),
    Target("labels", _labels, lambda: _NAMES, share=30, short=800, most_bytes=20_000),
)
