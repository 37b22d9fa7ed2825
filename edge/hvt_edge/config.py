"""Every setting of ``hvt-edge``, its default and the accepted values."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from hvt_common.config import (
    AUTO,
    BITRATE,
    BYTES,
    DURATION,
    PATH,
    PLACE,
    SHARE,
    SIZE,
    TEXT,
    Group,
    checked,
    choice,
    integer,
    number,
    or_auto,
)
from hvt_common.errors import UserError
from hvt_common.inference.heads import HEAD_NAMES
from hvt_common.inference.runtimes.providers import PROVIDERS
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.inference.tiles import parse_tiles
from hvt_common.protocol.channels import EdgeKeys
from hvt_common.protocol.ledger import MOST_WINDOW_NS
from hvt_common.runtime.log import LOG_FORMATS
from hvt_common.transport.zenoh_config import DEFAULT_ENDPOINT
from hvt_common.units import bitrate_text
from hvt_common.video.still_codecs import still_codec
from hvt_edge.operating import FIRST_SHARE, base_rate_bps
from hvt_edge.profiles import PROFILES, REGIMES
from hvt_edge.source.contract import check_shape
from hvt_edge.stills.policy.registry import METHODS, method, tuning
from hvt_edge.video.encoder import (
    PASSTHROUGH,
    PRESETS,
    SLOWEST,
    X265,
    check_encoder,
    keyframe_total_bps,
    least_base_bps,
)

DEFAULT_FPS = 15.0
DEFAULT_SIZE = (1280, 720)
_LEAST_WINDOW_S, _MOST_WINDOW_S = 0.5, MOST_WINDOW_NS / 1e9
_LEAST_SHARE = 0.01
_R0_DEPTH = 0.1
_MIN_BUDGET_BPS = 100_000
_STORE_BYTES = 200_000_000
_LEAST_STORE_BYTES = 10_000_000
_CODEC = checked(still_codec)
LEAST_FPS = 2.0
"""The lowest rate of ``--fps auto``: two frames in a window of a second."""
_AUTO_FIRST_SHARE = 0.95
"""The first share of ``--profile auto``: stills begin with the least."""
POSE_BPS = 1_200
"""The share of ``--pose`` in the budget: a message a second."""
TRACKS_BPS = 8_000
"""The share of ``--send-tracks`` in the budget: about 45 boxes three times a second."""

_SOURCE, _LINK, _SENT = Group("source"), Group("budget and link"), Group("what to send")
_MODELS, _FILES = Group("models"), Group("files")
_SOURCE_RARE, _LINK_RARE, _SENT_RARE, _MODELS_RARE, _FILES_RARE = (
    replace(group, rare=True) for group in (_SOURCE, _LINK, _SENT, _MODELS, _FILES)
)


@dataclass(frozen=True, slots=True)
class EdgeConfig:
    """The settings of ``hvt-edge``. See ``--help-all`` for each."""

    USUAL: ClassVar = (PROFILES[AUTO], "with --method/--regime")

    source: str | None = _SOURCE.option(
        PLACE, None, "clip.mp4, folder/, rtsp://…, /dev/video0, demo or demo:codes,4k"
    )
    edge_id: str = _SOURCE.option(checked(EdgeKeys), "edge-1", "name of this edge: 1 to 32 of a-z, 0-9 and -")
    size: tuple[int, int] | str | None = _SOURCE.option(
        or_auto(SIZE),
        None,
        "size of the base stream in pixels; auto: as large as the rate carries",
        shown_default="1280x720, less for a small source or a small --budget",
    )
    fps: float | str = _SOURCE.option(
        or_auto(number(0.1, 240, unit=" frames a second")),
        DEFAULT_FPS,
        "frame rate of the base stream; auto: up to 15, fewer and better frames where the rate is thin",
    )
    fit: str = _SOURCE_RARE.option(
        choice("letterbox", "crop"), "letterbox", "another aspect ratio: with black bars, or with cut edges"
    )
    source_fps: float | None = _SOURCE_RARE.option(
        number(0.1, 1000), None, "frame rate of an image folder; of a video, in place of its time stamps"
    )
    follow: bool = _SOURCE_RARE.switch(
        "wait for a video file that is still written; ends after 10 s without more"
    )
    pose: str | None = _SOURCE.option(
        PLACE,
        None,
        "where the camera is: FILE.csv, .srt (DJI), .gpx, fixed:LAT,LON,HEIGHT,AZIMUTH,TILT or mavlink:…",
    )
    fov: float | None = _SOURCE_RARE.option(
        number(1, 179, unit=" degrees"), None, "horizontal field of view in degrees, where --pose has none"
    )
    seed: int = _SOURCE_RARE.option(integer(0, 2**31 - 1), 0, "seed of the demo scene")
    max_frames: int | None = _SOURCE_RARE.option(integer(1, 10**9), None, "end after this many base frames")
    pace: str = _SOURCE_RARE.option(
        choice("realtime", "lockstep"), "realtime", "at the clip's speed, or as fast as both sides allow"
    )

    budget: int | None = _LINK.option(
        BITRATE, None, "bits a second in all, every byte counted", shown_default="800kbps"
    )
    video_share: float | str | None = _LINK.option(
        or_auto(SHARE),
        None,
        "share of the budget for the base stream; auto follows the scene",
        shown_default="0.8125 (1 for M0)",
    )
    regime: str | None = _LINK_RARE.option(
        choice(*REGIMES), None, "a budget of the paper: low 0.80 Mbps, moderate 1.40 Mbps"
    )
    adapt: bool = _LINK.switch(
        "follow the link's rate below --budget by the ground's reports; never in lockstep", default=True
    )
    min_budget: int | None = _LINK_RARE.option(
        BITRATE, None, "floor of --adapt", shown_default="100kbps, at most --budget"
    )
    window: float = _LINK_RARE.option(DURATION, 1.0, "the budget holds in every window of this length")
    connect: tuple[str, ...] = _LINK.option(
        TEXT,
        (),
        "Zenoh endpoint to connect to, for example tcp/HOST:7447",
        many=True,
        shown_default=DEFAULT_ENDPOINT,
    )
    listen: tuple[str, ...] = _LINK.option(TEXT, (), "Zenoh endpoint to listen on", many=True)
    zenoh_config: Path | None = _LINK.option(
        PATH, None, "JSON5 file of Zenoh settings: it overrides HVT's own, --listen and --connect override it"
    )
    links: int = _LINK_RARE.option(
        integer(1, 2), 1, "2: one Zenoh link for urgent messages and one for the rest (docs/adaptation.md)"
    )
    insecure: bool = _LINK_RARE.switch("allow listening beyond this machine without keys")
    wait: float = _LINK.option(DURATION, 15.0, "how long a clip waits for its first ground before it plays")

    method: str = _SENT.option(
        choice(*METHODS, elsewhere=dict.fromkeys(PROFILES, "--profile")),
        "M5",
        "which tracks get a still, and when (docs/methods.md)",
    )
    profile: str | None = _SENT.option(
        choice(*PROFILES),
        None,
        "settings in one word: auto, thin, paper (docs/methods.md), or a method of hvt-study compare",
        shown_default="auto, or none where --method or --regime is given",
    )
    tune: tuple[str, ...] = _SENT_RARE.option(
        TEXT, (), "a parameter of the method, KEY=VALUE (docs/methods.md)", many=True
    )
    borrow_unused: bool = _SENT_RARE.switch(
        "stills may use the unspent bits of the base stream, never beyond --budget"
    )
    group_stills: bool = _SENT_RARE.switch("neighbours share one still where that is cheaper")
    cooldown: float = _SENT_RARE.option(
        DURATION, 2.0, "least time between two stills of a track; 0 for the paper's plain methods"
    )
    min_gain: float = _SENT_RARE.option(
        number(1, 100), 1.2, "within 5 x --cooldown another still only of a track this much larger or sharper"
    )
    still_codec: str = _SENT.option(
        _CODEC, "jpeg", "codec of stills; residual sends the difference to the base"
    )
    fallback_codec: str = _SENT_RARE.option(
        _CODEC, "h264-intra", "codec of a still for which residual has no base picture, or is no smaller"
    )
    jpeg_quality: int = _SENT.option(
        integer(5, 95), 65, "quality of the stills, in percent, whatever the codec"
    )
    fidelity: float = _SENT_RARE.option(
        number(0, 60, unit=" dB"),
        0.0,
        "luma PSNR in dB for which a still gets just enough bytes; 0: by --jpeg-quality",
    )
    gate: float = _SENT_RARE.option(
        number(0, 60, unit=" dB"), 0.0, "no still of what video shows with this luma PSNR, in dB; 0: no gate"
    )
    padding: float = _SENT_RARE.option(number(0, 1), 0.15, "margin around a box, as a share of its sides")
    send_tracks: bool = _SENT.switch("also send the edge's own tracks, a few kbps, as part of --budget")
    roi_depth: float = _SENT_RARE.option(
        number(0, 1), 0.0, "finer quantiser where tracks are: 0.1 is 5 of 51 steps, as for R0; 0: off"
    )
    keyframe_interval: float | str = _SENT_RARE.option(
        or_auto(DURATION),
        AUTO,
        "time between scheduled keyframes; 0: on request only; auto: 10s, up to 60s on a thin link",
    )
    encoder: str = _SENT_RARE.option(
        TEXT,
        X265,
        "x265, hevc_nvenc, hevc_qsv, hevc_v4l2m2m, one that a package brings, or passthrough: a camera's own HEVC",
    )
    preset: str = _SENT_RARE.option(
        choice(AUTO, *PRESETS),
        AUTO,
        "x265 preset; auto: veryfast, in real time a faster one where that takes too much of the processor",
    )

    detector: str = _MODELS.option(
        TEXT,
        EMBEDDED_DETECTOR,
        "FILE.onnx or .xml, a name of hvt-models list (NAME:TEXT for a plug-in), several joined by +, or motion",
    )
    labels: Path | None = _MODELS.option(
        PATH, None, "class names of the detector: a file of one a line, or coco or visdrone"
    )
    head: str | None = _MODELS_RARE.option(
        choice(*HEAD_NAMES),
        None,
        "layout of the detector's outputs (docs/models.md), if HVT does not recognise it",
    )
    candidates: str = _MODELS.option(
        choice("decoded", "source"), "decoded", "detect on the decoded base stream or on the source frame"
    )
    tiles: str = _MODELS_RARE.option(
        checked(parse_tiles),
        "off",
        "also detect in tiles of the source: COLUMNSxROWS such as 2x2, off, or auto, which in real time searches "
        "other scales too; search: in lockstep as well; needs --candidates source",
    )
    detect_every: int | None = _MODELS_RARE.option(
        integer(1, 1000, unit=" frames"),
        None,
        "detect on every n-th frame",
        shown_default="5; less at few frames a second; up to 15 while tracks move as predicted",
    )
    confidence: float | None = _MODELS.option(
        number(0.01, 1),
        None,
        "confidence of a detection that starts a track",
        shown_default="the detector's own, else 0.25",
    )
    nms_iou: float = _MODELS_RARE.option(
        number(0.01, 1), 0.45, "overlap above which two boxes of a class are one"
    )
    camera_motion: str = _MODELS_RARE.option(
        choice("off", "flow"),
        "flow",
        "how boxes move between detections: flow: by the picture's optical flow; off: at their last speed",
    )
    threads: int = _MODELS_RARE.option(integer(1, 64), 1, "threads of the detector")
    provider: str = _MODELS.option(
        choice(*PROVIDERS), "auto", "runtime of the detector; auto says its choice and why"
    )

    ring: int = _FILES_RARE.option(
        BYTES, 24_000_000, "memory for source frames, from which stills are served on demand; 0 for none"
    )
    ring_time: float = _FILES_RARE.option(
        DURATION, 5.0, "how far back --ring goes; if it is too small, with frames left out"
    )
    store: int | None = _FILES.option(
        BYTES,
        None,
        "disk for video and stills of an outage, sent afterwards; 0 for none",
        shown_default="200MB for a camera or stream, or with a folder; else 0",
    )
    store_folder: Path | None = _FILES_RARE.option(
        PATH,
        None,
        "folder of --store; made when the link first goes down",
        shown_default="~/.local/state/hvt/EDGE_ID",
    )
    store_age: float = _FILES_RARE.option(
        DURATION, 3600.0, "video and stills of earlier runs that are older are dropped at the start"
    )
    record_base: Path | None = _FILES_RARE.option(
        PATH, None, "also keep the base stream in this Matroska file"
    )
    truth: Path | None = _FILES_RARE.option(PATH, None, "write the demo's ground truth, MOTChallenge form")
    metrics: str | None = _FILES_RARE.option(
        TEXT,
        None,
        "answer Prometheus (/metrics), /healthz, /readyz and hvt-edge status at HOST:PORT, unencrypted",
    )
    summary: Path | None = _FILES.option(PATH, None, "write the summary as JSON")
    log_format: str = _FILES_RARE.option(
        choice(*LOG_FORMATS), "text", "json: one object a line, also the status now and then and the summary"
    )
    quiet: bool = _FILES.switch("no status line")

    def store_bytes(self, *, live: bool) -> int:
        """Space of the backlog. Unrelated clips share its default folder: they are stored only on request."""
        if self.pace == "lockstep":
            return 0
        if self.store is not None:
            return self.store
        return _STORE_BYTES if live or self.store_folder is not None else 0

    @property
    def budget_bps(self) -> int:
        """B_tot in bits a second."""
        assert self.budget is not None, "check() fills it"
        return self.budget

    @property
    def floor_bps(self) -> int:
        """The floor of ``--adapt``, in bits a second."""
        return min(self.budget_bps, self.min_budget_bps)

    @property
    def min_budget_bps(self) -> int:
        """The floor of ``--adapt``, unless the budget itself is lower."""
        return self.min_budget or _MIN_BUDGET_BPS

    @property
    def adapts(self) -> bool:
        """Whether the rate follows the link; in lockstep the same input gives the same bytes."""
        return self.adapt and self.pace == "realtime"

    @property
    def window_ns(self) -> int:
        return round(self.window * 1e9)

    @property
    def share(self) -> float:
        """The base stream's share of the budget; the first one, if it is to follow the scene."""
        assert self.video_share is not None, "check() fills it"
        if not isinstance(self.video_share, str):
            return self.video_share
        return _AUTO_FIRST_SHARE if self.measures else FIRST_SHARE

    @property
    def fixed_share(self) -> float | None:
        """The base stream's share of the budget; None if it is to follow the scene."""
        return None if isinstance(self.video_share, str) else self.share

    @property
    def measures(self) -> bool:
        """Whether tracks and stills are sent only while they are measured to pay (`hvt_edge.perception.auto`)."""
        return self.profile == "auto"

    @property
    def tracks_used(self) -> bool:
        """Whether the edge's tracks are sent, or decide where the encoder spends its bits; stills need them too."""
        return self.send_tracks or self.roi_depth > 0

    @property
    def auto_preset(self) -> bool:
        """Whether the preset is measured; in lockstep time does not matter."""
        return self.preset == AUTO and self.pace == "realtime" and self.encoder == X265

    @property
    def passes_through(self) -> bool:
        """Whether the camera's own units are the base stream: its size, rate and keyframes are not the edge's."""
        return self.encoder == PASSTHROUGH

    @property
    def metadata_bps(self) -> int:
        """The rate reserved for messages beside base and stills, in bits a second."""
        return (TRACKS_BPS if self.send_tracks else 0) + (POSE_BPS if self.pose else 0)

    @property
    def base_bps(self) -> int:
        """B_v in bits a second."""
        return base_rate_bps(self.budget_bps, self.share, metadata_bps=self.metadata_bps)

    @property
    def nominal_fps(self) -> float:
        """Frames a second that the edge analyzes; with ``--fps auto`` not all of them are sent."""
        return DEFAULT_FPS if isinstance(self.fps, str) else self.fps

    @property
    def auto_fps(self) -> bool:
        """Whether the rate decides how many source frames are coded."""
        return isinstance(self.fps, str)

    @property
    def fixed_size(self) -> tuple[int, int] | None:
        """(width, height) of the base stream; None where the rate or the source decides."""
        return None if isinstance(self.size, str) else self.size


def with_profile(config: EdgeConfig, *, given: Collection[str]) -> EdgeConfig:
    """The configuration with the profile's settings, except for fields that the user has ``given``.

    Without a profile it is auto, unless the user names a method or a regime.
    """
    profile = config.profile
    if profile is None and {"method", "regime"}.isdisjoint(given):
        profile = "auto"
    settings = {} if profile is None else {"profile": profile, **PROFILES[profile]}
    if config.regime is not None:  # it sets the share itself
        settings.pop("video_share", None)
    if config.encoder != X265:  # no other encoder takes regions
        settings.pop("roi_depth", None)
    if config.encoder == PASSTHROUGH:  # the camera decides on rate, size and bits
        settings = {**settings, "fps": AUTO, "size": None}
        if settings.get("video_share") == AUTO:
            settings["video_share"] = _AUTO_FIRST_SHARE
    if "candidates" in given and config.candidates != "source":
        settings.pop("tiles", None)
    return replace(config, **{name: value for name, value in settings.items() if name not in given})


def check(config: EdgeConfig) -> EdgeConfig:
    """Return the configuration with regime and shares resolved; raises `UserError` where settings contradict."""
    if config.source is None:
        raise UserError("--source is missing: give a clip, an image folder, rtsp://…, /dev/video0 or demo")
    check_shape(size=config.fixed_size or DEFAULT_SIZE, fps=config.nominal_fps)
    if config.regime and (config.budget is not None or config.video_share is not None):
        raise UserError(
            f"--regime {config.regime} already sets --budget and --video-share: leave one or the other out"
        )
    check_encoder(config.encoder)
    if config.preset == AUTO and not config.auto_preset:
        config = replace(config, preset=SLOWEST)
    config = _with_rates(config)
    if config.roi_depth and config.encoder != X265:
        raise UserError(
            f"--roi-depth {config.roi_depth:g} needs x265, and --encoder {config.encoder} takes no regions: "
            "give --roi-depth 0, and not --method R0"
        )
    if config.passes_through:
        _check_passthrough(config)
    _check_window(config)
    if config.min_budget is not None and config.min_budget > config.budget_bps:
        raise UserError(
            f"--min-budget {config.min_budget / 1000:g} kbps is more than --budget "
            f"{config.budget_bps / 1000:g} kbps: give less, or the same for a rate that does not change"
        )
    if config.store and config.store < _LEAST_STORE_BYTES:
        raise UserError(
            f"--store {BYTES.show(config.store)} does not hold half a minute of video: give "
            f"{_LEAST_STORE_BYTES // 10**6}MB or more, or 0 to store nothing"
        )
    _check_stills(config)
    if config.fixed_size is not None:
        check_rate(config, config.fixed_size)
    return config


def note_on_share(config: EdgeConfig, *, given: Mapping[str, Any]) -> str:
    """The sentence for a share that the user has ``given`` and the checked ``config`` does not have."""
    share = given.get("video_share", config.video_share)
    if share == config.video_share:
        return ""
    return (
        f"--video-share {share} does not count: method {config.method} sends video alone, in the whole budget"
    )


def check_rate(config: EdgeConfig, size: tuple[int, int]) -> None:
    """Raise `UserError` if the budget cannot carry a base stream of this size; a camera's rate is measured instead.

    See `least_budget_bps`.
    """
    if config.passes_through:
        return
    least_bps = least_budget_bps(config, size, share=config.share)
    if config.budget_bps < least_bps:
        by_share = least_bps > least_budget_bps(config, size, share=1.0)
        raise UserError(
            f"--budget {config.budget_bps / 1000:g} kbps is too little for {stream_text(config, size)}: give at "
            f"least {bitrate_text(least_bps)}, lower --size or --fps"
            f"{f', or raise --video-share {config.share:g}' if by_share else ''}"
        )


def least_budget_bps(config: EdgeConfig, size: tuple[int, int], *, share: float) -> int:
    """The least total, whole kilobits a second, with which a base stream of this size and share works.

    x265 can follow its part of the rate, and each window holds the smallest keyframe of a textured picture and the
    messages beside it. Below that the stream would be left out for seconds, or made ever coarser.
    """
    fps = LEAST_FPS if config.auto_fps else config.nominal_fps
    base_bps = least_base_bps(size, fps, edge_id=config.edge_id)
    keyframe_bps = keyframe_total_bps(
        size, window_s=config.window, metadata_bps=config.metadata_bps, edge_id=config.edge_id
    )
    return 1000 * math.ceil(max(base_bps / share, base_bps + config.metadata_bps, keyframe_bps) / 1000)


def stream_text(config: EdgeConfig, size: tuple[int, int]) -> str:
    """The stream that the least budget is for, such as ``1280x720 at 15 fps``."""
    fps = LEAST_FPS if config.auto_fps else config.nominal_fps
    what = f"{size[0]}x{size[1]} at {fps:g} fps"
    return what if config.window == 1 else f"{what} with --window {config.window:g}s"


def _with_rates(config: EdgeConfig) -> EdgeConfig:
    regime = REGIMES[config.regime or "low"]
    policy = method(config.method, **tuning(config.tune))
    share = regime.video_share if config.video_share is None else config.video_share
    share = 1.0 if policy.video_only else share
    if not isinstance(share, str) and not _LEAST_SHARE <= share <= 1:
        raise UserError(f"--video-share {share:g} leaves no base stream: give {_LEAST_SHARE} to 1")
    depth = _R0_DEPTH if policy.name == "R0" and not config.roi_depth else config.roi_depth
    return replace(config, budget=config.budget or regime.budget_bps, video_share=share, roi_depth=depth)


def _check_window(config: EdgeConfig) -> None:
    if not _LEAST_WINDOW_S <= config.window <= _MOST_WINDOW_S:
        raise UserError(
            f"--window {config.window:g}s is not accepted: give {_LEAST_WINDOW_S:g}s to {_MOST_WINDOW_S:g}s "
            "(shorter, and a keyframe fills more than a window)"
        )
    if config.window < 2 / config.nominal_fps:
        raise UserError(
            f"--window {config.window:g}s is shorter than two frames of --fps {config.nominal_fps:g}: give "
            f"--window {math.ceil(2000 / config.nominal_fps) / 1000:g}s or more, or another --fps"
        )


def _check_passthrough(config: EdgeConfig) -> None:
    for flag, value, why in (
        ("--size", config.size, "which sends the camera's own size: leave it out"),
        ("--video-share", config.video_share, "whose rate is the camera's: give a share"),
    ):
        if value == AUTO:
            raise UserError(f"{flag} auto is not accepted with --encoder passthrough, {why}")


def _check_stills(config: EdgeConfig) -> None:
    codec = still_codec(config.still_codec)
    if codec.needs_base and still_codec(config.fallback_codec).needs_base:
        raise UserError(
            f"--fallback-codec {config.fallback_codec} needs the base stream itself: give one that does not"
        )
    if parse_tiles(config.tiles) != "off" and config.candidates != "source":
        raise UserError(f"--tiles {config.tiles} cuts up the source: add --candidates source")
