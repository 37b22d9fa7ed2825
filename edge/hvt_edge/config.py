"""Every setting of ``hvt-edge``, its default and what is accepted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from hvt_common.config import (
    BITRATE,
    DURATION,
    PATH,
    SHARE,
    SIZE,
    TEXT,
    choice,
    integer,
    number,
    option,
    switch,
)
from hvt_common.errors import UserError
from hvt_common.link.keys import EdgeKeys
from hvt_common.link.zenoh_config import DEFAULT_ENDPOINT
from hvt_common.units import bitrate_text
from hvt_common.vision.embedded import DETECTOR as EMBEDDED_DETECTOR
from hvt_common.vision.providers import PROVIDERS
from hvt_edge.encode import PRESETS
from hvt_edge.methods.registry import METHODS, method
from hvt_edge.rate import least_base_bps
from hvt_edge.source import check_shape

__all__ = ["REGIMES", "EdgeConfig", "Regime", "check"]


_LEAST_WINDOW_S, _MOST_WINDOW_S = 0.5, 60.0


@dataclass(frozen=True, slots=True)
class Regime:
    """A budget of the paper: so much in all, so much of it for video."""

    budget_bps: int
    video_share: float


REGIMES = {
    "low": Regime(budget_bps=800_000, video_share=0.8125),  # 0.65 + 0.15 Mbps
    "moderate": Regime(budget_bps=1_400_000, video_share=1.2 / 1.4),  # 1.20 + 0.20 Mbps
}


@dataclass(frozen=True, slots=True)
class EdgeConfig:
    """What ``hvt-edge`` runs with. See ``--help`` for each."""

    source: str | None = option(TEXT, None, "clip.mp4, folder/, rtsp://…, /dev/video0 or demo")
    edge_id: str = option(TEXT, "edge-1", "name of this edge: 1 to 32 of a-z, 0-9 and -")
    size: tuple[int, int] = option(SIZE, (1280, 720), "size of the base stream in pixels")
    fps: float = option(number(0.1, 240, unit=" frames a second"), 15.0, "frame rate of the base stream")
    fit: str = option(choice("letterbox", "crop"), "letterbox", "how another aspect ratio is fitted")
    source_fps: float | None = option(
        number(0.1, 1000), None, "frame rate of an image folder, or instead of what a file says"
    )
    seed: int = option(integer(0, 2**31 - 1), 0, "seed of the demo scene")
    max_frames: int | None = option(integer(1, 10**9), None, "end after this many base frames")

    budget: int | None = option(
        BITRATE, None, "bits a second in all, every byte counted", shown_default="800kbps"
    )
    video_share: float | None = option(
        SHARE, None, "share of the budget for the base stream", shown_default="0.8125; 1 for M0"
    )
    regime: str | None = option(
        choice(*REGIMES), None, "a budget of the paper: low 0.80 Mbps, moderate 1.40 Mbps"
    )
    window: float = option(DURATION, 1.0, "the budget holds in every rolling window of this length")

    method: str = option(choice(*METHODS), "M5", "who gets a still, and when")
    cooldown: float = option(
        DURATION, 2.0, "least time between two stills of a track; 0 for the paper's plain methods"
    )
    min_gain: float = option(
        number(1, 100), 1.2, "a track is sent again only when this much larger or sharper"
    )
    still_codec: str = option(TEXT, "jpeg", "how stills are coded; residual sends what the base lacks")
    fallback_codec: str = option(
        TEXT, "h264-intra", "how a still is coded where residual does not serve: no base, or no gain"
    )
    jpeg_quality: int = option(integer(5, 95), 65, "quality of the stills, in percent, whatever the codec")
    fidelity: float = option(
        number(0, 60, unit=" dB"),
        0.0,
        "fewest bytes that bring a still this near to the source; 0: --jpeg-quality",
    )
    gate: float = option(
        number(0, 60, unit=" dB"), 0.0, "no still where the base is already this good (luma PSNR); 0: no gate"
    )
    padding: float = option(number(0, 1), 0.15, "margin around a box, as a share of its sides")

    detector: str = option(
        TEXT, EMBEDDED_DETECTOR, "FILE.onnx, a name of hvt-models list, or motion, which needs no model"
    )
    labels: Path | None = option(PATH, None, "class names of the detector, one a line")
    candidates: str = option(
        choice("decoded", "source"), "decoded", "detect on the decoded base stream or on the source frame"
    )
    tiles: str = option(
        TEXT, "off", "detect in tiles of the source too: CxR, auto, or off; needs --candidates source"
    )
    send_tracks: bool = switch("also send the edge's own tracks, a few kbps, as part of --budget")
    detect_every: int = option(integer(1, 1000, unit=" frames"), 5, "detect on every n-th frame")
    confidence: float = option(number(0.01, 1), 0.25, "confidence from which a detection starts a track")
    nms_iou: float = option(number(0.01, 1), 0.45, "overlap above which two boxes of a class are one")
    camera_motion: str = option(
        choice("off", "flow", "ecc"), "flow", "how the tracker follows the camera's own motion"
    )
    threads: int = option(integer(1, 64), 2, "threads of the detector")
    provider: str = option(
        choice(*PROVIDERS), "auto", "what runs the detector; auto says what it took and why"
    )

    preset: str = option(choice(*PRESETS), "veryfast", "x265 preset")
    pulse: float = option(DURATION, 0.0, "a whole frame at better quality once in so long; 0 for none")
    pulse_depth: float = option(number(0.05, 1), 0.3, "how much better a pulse is (x265 offset of -51 at 1)")
    rolling: str = option(
        TEXT, "off", "pulses of one region a frame in rotation, grid CxR, tracks first; or off"
    )
    rolling_depth: float = option(number(0.05, 1), 0.4, "how much better the region is")
    roi_depth: float = option(
        number(0, 1), 0.0, "quantise active tracks better by so much; 0 for not, 0.1 for --method R0"
    )
    keyframe_interval: float = option(DURATION, 10.0, "time between keyframes; 0 for on demand only")
    pace: str = option(
        choice("realtime", "lockstep"), "realtime", "play at the clip's speed, or as fast as all parts allow"
    )
    connect: tuple[str, ...] = option(
        TEXT,
        (),
        "Zenoh endpoint to connect to, for example tcp/HOST:7447",
        many=True,
        shown_default=DEFAULT_ENDPOINT,
    )
    listen: tuple[str, ...] = option(TEXT, (), "Zenoh endpoint to listen on", many=True)
    zenoh_config: Path | None = option(PATH, None, "Zenoh configuration, JSON5, that all this goes on top of")
    insecure: bool = switch("allow listening beyond this machine without keys")
    wait: float = option(
        DURATION, 15.0, "how long a file, a folder or the demo waits for the first ground before it plays"
    )
    record_base: Path | None = option(PATH, None, "also keep the base stream in this Matroska file")
    truth: Path | None = option(PATH, None, "write the demo's ground truth, MOTChallenge form")
    summary: Path | None = option(PATH, None, "write the summary as JSON")
    quiet: bool = switch("no status line")

    @property
    def budget_bps(self) -> int:
        """B_tot in bits a second."""
        assert self.budget is not None, "check() fills it"
        return self.budget

    @property
    def base_bps(self) -> int:
        """B_v in bits a second."""
        assert self.video_share is not None, "check() fills it"
        return round(self.budget_bps * self.video_share)


def check(config: EdgeConfig) -> EdgeConfig:
    """Return the configuration with regime and shares settled; `UserError` where settings contradict."""
    if config.source is None:
        raise UserError("--source is missing: give a clip, an image folder, rtsp://…, /dev/video0 or demo")
    EdgeKeys(config.edge_id)
    check_shape(size=config.size, fps=config.fps)
    if config.regime and (config.budget is not None or config.video_share is not None):
        raise UserError(
            f"--regime {config.regime} already sets --budget and --video-share: leave one or the other out"
        )
    regime = REGIMES[config.regime or "low"]
    video_only = method(config.method).video_only
    share = 1.0 if video_only else regime.video_share if config.video_share is None else config.video_share
    if not 0 < share <= 1:
        raise UserError(f"--video-share {share:g} leaves no base stream: give more than 0, at most 1")
    if not _LEAST_WINDOW_S <= config.window <= _MOST_WINDOW_S or config.window < 2 / config.fps:
        raise UserError(
            f"--window {config.window:g}s is not accepted: give {_LEAST_WINDOW_S:g}s to {_MOST_WINDOW_S:g}s, and two "
            f"frames at least (shorter, and a keyframe fills more than a window)"
        )
    config = replace(config, budget=config.budget or regime.budget_bps, video_share=share)
    least_bps = least_base_bps(config.size, config.fps, edge_id=config.edge_id)
    if config.base_bps < least_bps:
        raise UserError(
            f"--budget {bitrate_text(config.budget_bps)} leaves {bitrate_text(config.base_bps)} for video, but "
            f"{config.size[0]}x{config.size[1]} at {config.fps:g} fps takes at least {bitrate_text(least_bps)}: "
            "raise --budget, or lower --size or --fps"
        )
    return config
