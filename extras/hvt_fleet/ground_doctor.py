"""``hvt-ground doctor``: checks the needs of a ground with these settings; requests nothing, changes nothing."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import zenoh

from hvt_common.config import load
from hvt_common.inference.detect import detect_every
from hvt_common.protocol.channels import Channel, parse_key, selector
from hvt_common.runtime.reporting import Finding, check_folder, check_writable
from hvt_fleet.checkup import check_clock, check_link, check_metrics, print_findings, run_checks
from hvt_ground.config import GroundConfig
from hvt_ground.extras import checked, config_class, extras_of, written
from hvt_ground.perception.models import Models
from hvt_ground.wiring.sessions import is_file

_DESCRIPTION = (
    "Check what a ground with these settings needs; takes the settings of hvt-ground. --json is for programs."
)
_USUAL_FPS, _USUAL_SIZE = 15.0, (1280, 720)
_USUAL_BPS = 1e6
_LITTLE_H = 1.0


def run(argv: Sequence[str]) -> int:
    """0 where a ground could start, 2 where something is wrong."""
    words = [one for one in argv if one != "--json"]
    config, _ = load(config_class(), words, program="hvt-ground doctor", description=_DESCRIPTION)
    config = checked(config)
    logging.getLogger("hvt_common.inference.runtimes.model").setLevel(logging.INFO)  # for its provider
    checks: dict[str, Callable[[], Finding]] = {
        "models": lambda: _models(config),
        "recordings": lambda: _recordings(config),
        "ports": lambda: check_metrics(config.metrics),
        **dict(one for extra in extras_of(config) for one in extra.checks(config).items()),
        "clock": check_clock,
        "link": lambda: check_link(config.link, _edges, other="edge"),
    }
    return print_findings("hvt-ground doctor", run_checks(checks), as_json=len(words) < len(argv))


def _models(config: GroundConfig) -> Finding:
    detector, classifier = Models(config).wait()
    picture = np.full((_USUAL_SIZE[1], _USUAL_SIZE[0], 3), 128, np.uint8)
    began_s = time.monotonic()
    detector.detect(picture)
    took_s = time.monotonic() - began_s
    a_second = _USUAL_FPS / detect_every(config.detect_every, fps=_USUAL_FPS)
    edges = int(1 / (took_s * a_second))
    names = config.detector if classifier is None else f"{config.detector}, {config.classifier}"
    found = f"{names}: {1000 * took_s:.0f} ms a picture of 1280x720"
    if not edges:
        return Finding(
            "warning", f"{found}: too slow for one edge", "give --detect-every more, or a lighter --detector"
        )
    return Finding("ok", f"{found}, enough for about {edges} edge{'s' * (edges > 1)} of 15 fps")


def _recordings(config: GroundConfig) -> Finding:
    for name, path, suffix, _ in written(config):
        if is_file(path, suffix):
            check_writable(path, name=name)
        else:
            check_folder(path, name=name)
    folder = config.record_folder or (Path() if config.record is None else config.record.absolute().parent)
    free = shutil.disk_usage(check_folder(folder, name="--record")).free
    hours = 8 * free / _USUAL_BPS / 3600
    found = f"{folder.absolute()}: {free / 1e9:.1f} GB are free, {hours:.0f} hours of an edge at 1 Mbps"
    if hours < _LITTLE_H:
        return Finding("warning", found, "make room, or give --keep a size")
    return Finding("ok", found)


def _edges(session: zenoh.Session) -> str:
    replies = session.liveliness().get(selector(Channel.ALIVE), timeout=1.0)
    keys = [parse_key(str(one.ok.key_expr)) for one in replies if one.ok is not None]
    names = sorted({key[0] for key in keys if key is not None})
    return f"edges: {', '.join(names)}" if names else ""
