"""Every setting of ``hvt-ground``, its default and the accepted values."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from hvt_common.config import DURATION, PATH, TEXT, Group, SettingType, checked, choice, integer, number
from hvt_common.errors import UserError, check_apart
from hvt_common.inference.heads import HEAD_NAMES
from hvt_common.inference.runtimes.providers import PROVIDERS
from hvt_common.inference.store import EMBEDDED_CLASSIFIER, EMBEDDED_DETECTOR, parts_of
from hvt_common.protocol.channels import GroupKeys, check_edge_pattern
from hvt_common.runtime.log import LOG_FORMATS
from hvt_common.transport.link_doctor import link_doctor
from hvt_common.transport.zenoh_config import DEFAULT_ENDPOINT, LinkSettings
from hvt_common.units import Limit, parse_limit

DETECTOR, NONE, MOTION = "detector", "none", "motion"


class Written(NamedTuple):
    """An output. A path with the suffix is a file, another one a folder with a file for each session.

    Where the suffix is empty the path is always a file.
    """

    name: str
    """Of its option."""
    path: Path
    suffix: str
    beside: str = ""
    """The glob of other files that belong to a named one, behind its stem."""


_LIMIT = SettingType("LIMIT", parse_limit)

_LINK, _MODELS, _FILES = Group("link and edges"), Group("models"), Group("files and views")
_LINK_RARE, _MODELS_RARE, _FILES_RARE = (replace(group, rare=True) for group in (_LINK, _MODELS, _FILES))


@dataclass(frozen=True, slots=True)
class GroundConfig:
    """The settings of ``hvt-ground``. See ``--help-all`` for each."""

    listen: tuple[str, ...] = _LINK.option(
        TEXT, (), "Zenoh endpoint to listen on", many=True, shown_default=DEFAULT_ENDPOINT
    )
    connect: tuple[str, ...] = _LINK.option(
        TEXT, (), "Zenoh endpoint to connect to, for example tcp/HOST:7447", many=True
    )
    zenoh_config: Path | None = _LINK.option(
        PATH, None, "JSON5 file of Zenoh settings: it overrides HVT's own, --listen and --connect override it"
    )
    links: int = _LINK_RARE.option(
        integer(1, 2), 1, "2: where it connects, one Zenoh link for urgent messages and one for the rest"
    )
    insecure: bool = _LINK.switch("allow listening beyond this machine without keys")
    edges: str = _LINK.option(checked(check_edge_pattern), "*", "which edges to serve, for example 'uav-*'")
    group: str | None = _LINK_RARE.option(
        checked(GroupKeys),
        None,
        "share the edges with all grounds of this group: each edge is served by one of them",
    )
    once: bool = _LINK.switch("end when the edges have ended")
    wait: float = _LINK.option(
        DURATION, 0.0, "with --once: give up when no edge came for so long; 0 waits for ever"
    )
    patience: float | None = _LINK_RARE.option(
        DURATION,
        None,
        "how long an edge may be silent before its session is closed",
        shown_default="10min; 5s with --once",
    )

    detector: str = _MODELS.option(
        TEXT,
        EMBEDDED_DETECTOR,
        "FILE.onnx or .xml, a name of hvt-models list (NAME:TEXT for a plug-in), several joined by +, or motion",
    )
    labels: Path | None = _MODELS.option(PATH, None, "class names of the classifier, one a line")
    detector_labels: Path | None = _MODELS_RARE.option(
        PATH, None, "class names of the detector: a file of one a line, or coco or visdrone"
    )
    head: str | None = _MODELS_RARE.option(
        choice(*HEAD_NAMES),
        None,
        "layout of the detector's outputs (docs/models.md), if HVT does not recognise it",
    )
    tiles: str = _MODELS_RARE.option(
        choice("auto", "search", "off"),
        "auto",
        "search: also detect on enlarged quarters where these show far more objects; auto: the same, not in lockstep",
    )
    detect_every: int | None = _MODELS.option(
        integer(1, 1000, unit=" frames"),
        None,
        "detect on every n-th frame, more seldom when behind",
        shown_default="5; less at few frames a second; up to 15 while tracks move as predicted",
    )
    confidence: float | None = _MODELS.option(
        number(0.01, 1),
        None,
        "confidence from which a detection starts a track",
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
    classifier: str | None = _MODELS.option(
        TEXT,
        None,
        "reads stills: FILE.onnx, a name of hvt-models list, none, or detector, again with the stills pasted in",
        shown_default="aerial-cls; detector where --detector is without aerial-nano",
    )
    refine: str = _MODELS.option(
        choice("replace", "fuse"),
        "fuse",
        "a still's class replaces the track's, or is weighed with the others",
    )
    threads: int = _MODELS_RARE.option(integer(1, 64), 1, "threads of the detector and the classifier")
    provider: str = _MODELS.option(
        choice(*PROVIDERS), "auto", "runtime of the networks; auto says its choice and why"
    )

    record: Path | None = _FILES.option(
        PATH, None, "FILE.rrd, or a folder for one file an edge", shown_default="hvt-<edge>-<time>.rrd here"
    )
    split: Limit | None = _FILES.option(
        _LIMIT, None, "begin a new file of the recording after this time or size, at the next keyframe"
    )
    metrics: str | None = _FILES.option(
        TEXT,
        None,
        "answer Prometheus (/metrics), /healthz, /readyz and hvt-ground status at HOST:PORT, unencrypted",
    )
    summary: Path | None = _FILES.option(PATH, None, "write the summary as JSON")
    log_format: str = _FILES_RARE.option(
        choice(*LOG_FORMATS), "text", "json: one object a line, also the status now and then and the summary"
    )
    quiet: bool = _FILES.switch("no status line")

    @property
    def written(self) -> list[Written]:
        given = (("--record", self.record, ".rrd"), ("--summary", self.summary, ""))
        return [Written(name, path, suffix) for name, path, suffix in given if path is not None]

    @property
    def record_folder(self) -> Path | None:
        """The folder of recordings; None where one file was named, or nothing."""
        if self.record is None or (self.record.suffix == ".rrd" and not self.record.is_dir()):
            return None
        return self.record

    @property
    def link(self) -> LinkSettings:
        return LinkSettings(
            role="ground",
            listen=self.listen,
            connect=self.connect,
            zenoh_config=self.zenoh_config,
            insecure=self.insecure,
            links=2 if self.links == 2 else 1,
        )

    @property
    def patience_s(self) -> float:
        """The absence after which an edge has ended."""
        if self.patience is not None:
            return self.patience
        return 5.0 if self.once else 600.0


def check(config: GroundConfig, *, more: Iterable[Written] = ()) -> GroundConfig:
    """Return the configuration; `UserError` where settings contradict. ``more`` is written, too."""
    files = (
        (one.name, one.path)
        for one in (*config.written, *more)
        if one.path.suffix == (one.suffix or one.path.suffix)
    )
    check_apart(files)  # files in a folder have names of their own
    if config.group is not None:
        link_doctor().sharer()  # refused here, before anything is opened or written
    if config.labels is not None and config.classifier in (None, DETECTOR, NONE):
        raise UserError(
            f"--labels {config.labels} names a classifier's classes, but --classifier is no file: give one"
        )
    if config.classifier == DETECTOR and config.detector == MOTION:
        raise UserError(
            f"--classifier {DETECTOR} needs a detector that knows classes, and --detector is {MOTION}: give a model"
        )
    if config.classifier is None:
        embedded = {MOTION, EMBEDDED_DETECTOR}.intersection(parts_of(config.detector))
        classifier = EMBEDDED_CLASSIFIER if embedded else DETECTOR
        return replace(config, classifier=classifier)
    return config
