"""Every setting of ``hvt-ground``, its default and what is accepted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from hvt_common.config import DURATION, PATH, TEXT, choice, integer, number, option, switch
from hvt_common.errors import UserError
from hvt_common.link.zenoh_config import DEFAULT_ENDPOINT
from hvt_common.vision.embedded import CLASSIFIER as EMBEDDED_CLASSIFIER
from hvt_common.vision.embedded import DETECTOR as EMBEDDED_DETECTOR
from hvt_common.vision.providers import PROVIDERS

__all__ = ["DETECTOR", "NONE", "GroundConfig", "check"]

DETECTOR, NONE, MOTION = "detector", "none", "motion"


@dataclass(frozen=True, slots=True)
class GroundConfig:
    """What ``hvt-ground`` runs with. See ``--help`` for each."""

    listen: tuple[str, ...] = option(
        TEXT, (), "Zenoh endpoint to listen on", many=True, shown_default=DEFAULT_ENDPOINT
    )
    connect: tuple[str, ...] = option(
        TEXT, (), "Zenoh endpoint to connect to, for example tcp/HOST:7447", many=True
    )
    zenoh_config: Path | None = option(PATH, None, "Zenoh configuration, JSON5, that all this goes on top of")
    insecure: bool = switch("allow listening beyond this machine without keys")
    edges: str = option(TEXT, "*", "which edges to serve, for example 'uav-*'")

    detector: str = option(
        TEXT, EMBEDDED_DETECTOR, "FILE.onnx, a name of hvt-models list, or motion, which needs no model"
    )
    labels: Path | None = option(PATH, None, "class names of the classifier, one a line")
    detector_labels: Path | None = option(PATH, None, "class names of the detector, one a line")
    detect_every: int = option(
        integer(1, 1000, unit=" frames"), 5, "detect on every n-th frame, less when behind"
    )
    confidence: float = option(number(0.01, 1), 0.25, "confidence from which a detection starts a track")
    nms_iou: float = option(number(0.01, 1), 0.45, "overlap above which two boxes of a class are one")
    camera_motion: str = option(
        choice("off", "flow", "ecc"), "flow", "how the tracker follows the camera's own motion"
    )
    classifier: str | None = option(
        TEXT,
        None,
        "FILE.onnx, a name of hvt-models list, none, or detector: it runs again with the stills pasted in",
        shown_default="aerial-cls; detector where --detector is another",
    )
    refine: str = option(
        choice("replace", "fuse"),
        "replace",
        "a still's class replaces the track's, or is weighed with the others",
    )
    threads: int = option(integer(1, 64), 2, "threads of the detector and the classifier")
    provider: str = option(
        choice(*PROVIDERS), "auto", "what runs the networks; auto says what it took and why"
    )

    record: Path | None = option(
        PATH, None, "FILE.rrd, or a folder for one file an edge", shown_default="hvt-<edge>-<time>.rrd here"
    )
    tracks: Path | None = option(
        PATH, None, "also write the tracks as a table: FILE.csv, or a folder for one file a session"
    )
    view: bool = switch("also open the Rerun viewer")
    serve: bool = switch("also serve the Rerun web viewer on this machine")
    once: bool = switch("end when the edges have ended")
    wait: float = option(
        DURATION, 0.0, "with --once: give up when no edge came for so long; 0 waits for ever"
    )
    summary: Path | None = option(PATH, None, "write the summary as JSON")
    quiet: bool = switch("no status line")


def check(config: GroundConfig) -> GroundConfig:
    """Return the configuration; `UserError` where settings contradict."""
    if config.view and config.serve:
        raise UserError("--view and --serve are both given: choose the viewer here or the one in a browser")
    if config.labels is not None and config.classifier in (None, DETECTOR, NONE):
        raise UserError(
            f"--labels {config.labels} names a classifier's classes, but --classifier is no file: give one"
        )
    if config.classifier == DETECTOR and config.detector == MOTION:
        raise UserError(
            f"--classifier {DETECTOR} needs a detector that knows classes, and --detector is {MOTION}: give a model"
        )
    if config.classifier is None:
        classifier = EMBEDDED_CLASSIFIER if config.detector in (MOTION, EMBEDDED_DETECTOR) else DETECTOR
        return replace(config, classifier=classifier)
    return config
