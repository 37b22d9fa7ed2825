"""``hvt-edge doctor``: checks the needs of a flight with these settings; sends nothing and changes nothing."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import zenoh

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_common.inference.detect import Detector, detect_every
from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.redaction import Redaction
from hvt_common.runtime.reporting import Finding, check_folder
from hvt_common.transport.session import declare_publisher
from hvt_common.values import Frame
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_edge.loop.counts import Cores, CpuMeter, processors
from hvt_edge.perception.cpu_budget import most_cores
from hvt_edge.source.contract import Source
from hvt_edge.source.opening import shown
from hvt_edge.video.encoder import Encoder
from hvt_edge.video.rate_model import PresetChoice, choose_preset, share_of
from hvt_edge.wiring import (
    Camera,
    check_codecs,
    check_files,
    check_store,
    first_decimation,
    first_rates,
    make_encoder,
    make_link_settings,
    qualify_encoder,
    store_folder,
    surveyed,
)
from hvt_edge.world import World
from hvt_fleet.checkup import check_clock, check_link, check_metrics, print_findings, run_checks
from hvt_fleet.link.duplicate_edge import refuse_duplicate_edge

_DESCRIPTION = (
    "Check what a flight with these settings needs; takes the settings of hvt-edge. --json is for programs."
)
_SAMPLE_S = 2.0
_MOST_FRAMES = 20
_SLOW = 0.9
"""A camera that gives less than this share of the rate is told of."""


def run(argv: Sequence[str]) -> int:
    """0 where a flight could start, 2 where something is wrong."""
    words = [one for one in argv if one != "--json"]
    config, given = load(EdgeConfig, words, program="hvt-edge doctor", description=_DESCRIPTION)
    config = check(with_profile(config, given=given.values))
    logging.getLogger("hvt_common.inference.runtimes.model").setLevel(logging.INFO)  # for its provider
    checks = _Checks(config)
    redaction = Redaction([*words, *given.values.values()])
    findings = {
        name: replace(one, found=redaction.text(one.found), todo=redaction.text(one.todo))
        for name, one in run_checks(checks.by_name).items()
    }
    checks.close()
    return print_findings(f"hvt-edge doctor: {config.edge_id}", findings, as_json=len(words) < len(argv))


class _Checks:
    # The checks in the order of the flight; later ones use parts that earlier ones have opened.

    def __init__(self, config: EdgeConfig) -> None:
        self._config = config
        self._world = World()
        self._source: Source | None = None
        self._camera: Camera | None = None
        self._detector: Detector | None = None
        self._frames: list[Frame] = []
        self._detect_s = 0.0
        """Processor time of one detection."""

    @property
    def by_name(self) -> dict[str, Callable[[], Finding]]:
        return {
            "source": self.source,
            "detector": self.detector,
            "codecs": self.codecs,
            "processor": self.processor,
            "files": self.files,
            "ports": lambda: check_metrics(self._config.metrics),
            "clock": check_clock,
            "link": self.link,
        }

    def close(self) -> None:
        """Let go of the source, unless its check still waits for it."""
        if self._source is not None:
            self._source.close()

    def source(self) -> Finding:
        """Opens it, and looks for two seconds how many pictures it gives."""
        config = self._config
        name = shown(str(config.source))
        source = self._world.open_source(config)
        try:
            self._config, self._camera = surveyed(config, source)
        except UserError:
            source.close()
            raise
        frames = source.frames(start_ns=self._world.clock())
        first = next(frames, None)
        if first is None:
            source.close()
            raise UserError(f"--source {name} gives no picture: name another")
        self._frames.append(first)
        began_s, count = time.monotonic(), 0
        while time.monotonic() - began_s < _SAMPLE_S and (source.live or count < _MOST_FRAMES):
            frame = next(frames, None)
            if frame is None:
                break
            count += 1
            if len(self._frames) < _MOST_FRAMES:
                self._frames.append(frame)
        self._source = source
        size, base = source.view.source_size, source.view.base_size
        found = f"{name}: {size[0]}x{size[1]}, sent as {base[0]}x{base[1]} at {source.fps:g} fps"
        found = "; ".join((found, *source.notes))
        rate = count / (time.monotonic() - began_s)
        if source.live and rate < _SLOW * source.fps:
            return Finding(
                "warning",
                f"{found}, but it gives {rate:.1f}",
                "set --fps to what it gives, or mend its light",
            )
        return Finding("ok", found)

    def detector(self) -> Finding:
        """Opens it, and runs it on a picture as the flight would."""
        if self._source is None:
            return Finding("unknown", "not tried without a source")
        detector = self._detector = self._world.open_detector(self._config)
        self._world.warm_up(self._config, detector, self._source)
        frame = self._frames[0]
        picture = frame.source_bgr if self._config.candidates == "source" else frame.base_bgr
        began_s, cpu_s = time.monotonic(), time.process_time()
        found = detector.detect(picture)
        self._detect_s = time.process_time() - cpu_s
        took_ms = 1000 * (time.monotonic() - began_s)
        for one in self._world.failures.now:  # of A+B the others go on
            if one.part.startswith("detector"):
                raise UserError(f"{one.part} does not run ({one.reason}): choose another with --detector")
        return Finding(
            "ok", f"{self._config.detector}: {took_ms:.0f} ms a picture, {len(found.class_ids)} found in one"
        )

    def codecs(self) -> Finding:
        """A still and a picture, there and back."""
        config = self._config
        check_codecs(config)
        if not self._frames or self._source is None:
            return Finding(
                "unknown", f"stills work ({config.still_codec}); no picture to code without a source"
            )
        size = self._source.view.base_size
        qualify_encoder(config, self._source, self._camera, clock=self._world.clock, stop=threading.Event())
        encoder = self._encoder(size)
        picture = BaseDecoder(size=size).decode_yuv(encoder.encode(self._frames[0], keyframe=True).data)
        if picture is None:
            return Finding(
                "wrong", f"{config.encoder}'s picture could not be decoded", "install the package av anew"
            )
        return Finding("ok", f"{config.encoder} and {config.still_codec} code and decode")

    def processor(self) -> Finding:
        """Compare the cost of every frame with the free processor time."""
        if self._source is None or not self._frames:
            return Finding("unknown", "not tried without a source")
        config, meter = self._config, CpuMeter()
        size = self._source.view.base_size
        fps = self._source.fps / first_decimation(config, size)
        encode_s, most_fps = self._coded(self._encoder(size))
        choice = PresetChoice()
        if config.auto_preset:
            choice = choose_preset(encode_s * fps, most_cores=share_of(processors()))
        if choice.says:
            encode_s, most_fps = self._coded(self._encoder(size, preset=choice.preset))
        meter.measure(scale=1.0, short=False)
        every = detect_every(config.detect_every, fps=self._source.fps)
        networks = 2 if config.measures else 1  # it searches the source and the base
        video, wanted = fps * encode_s, self._source.fps * networks * self._detect_s / every
        perceives = min(wanted, most_cores(processors(), others=video))
        free = meter.now.free
        if meter.now == Cores():  # this system does not say
            free = processors()
        codes = f"{config.encoder} codes {most_fps:.0f} fps of {fps:g} here"
        if config.passes_through:
            codes = "the camera codes"
        rarer = (
            f"objects are looked for less often: {wanted:.2g} cores are wanted" if perceives < wanted else ""
        )
        codes = "; ".join(filter(None, (codes, choice.says, rarer)))
        found = f"about {video + perceives:.2g} cores of {free:.1f} that are free; {codes}"
        if video > free or most_fps < fps:
            todo = "lower --fps or --size, or give --method M0; else frames are left out"
            return Finding("warning", found, todo)
        return Finding("ok", found)

    def files(self) -> Finding:
        """The files that will be written, and whether there is room."""
        config = self._config
        check_files(config)
        live = self._source is not None and self._source.live
        check_store(config, live=live)
        limit = config.store_bytes(live=live)
        if not limit:
            return Finding("ok", "nothing is stored while the link is down")
        folder = store_folder(config)
        free = shutil.disk_usage(check_folder(folder, name="--store-folder")).free
        hours = 8 * limit / config.budget_bps / 3600
        found = f"{folder}: {limit / 1e6:.0f} MB for outages, {hours:.1f} hours; {free / 1e9:.1f} GB are free"
        if free < limit:
            return Finding("warning", found, "make room, or give --store less")
        return Finding("ok", found)

    def link(self) -> Finding:
        """Keys, endpoints, another edge of this name, and a ground that listens."""
        settings, keys = make_link_settings(self._config), EdgeKeys(self._config.edge_id)
        refuse_duplicate_edge(settings, keys)
        publishers: list[zenoh.Publisher] = []

        def find_peer(session: zenoh.Session) -> str:
            if not publishers:
                publishers.append(declare_publisher(session, Channel.BASE, keys=keys))
            listened_to = bool(publishers[0].matching_status.matching)  # type: ignore[attr-defined]
            return "a ground listens" if listened_to else ""

        return check_link(settings, find_peer, other="ground")

    def _coded(self, encoder: Encoder) -> tuple[float, float]:
        # (processor seconds a frame, frames a second) of it.
        began_s, cpu_s = time.monotonic(), time.process_time()
        count = 0
        while time.monotonic() - began_s < _SAMPLE_S / 2:
            encoder.encode(self._frames[count % len(self._frames)])
            count += 1
        return (time.process_time() - cpu_s) / count, count / (time.monotonic() - began_s)

    def _encoder(self, size: tuple[int, int], *, preset: str = "") -> Encoder:
        rates = first_rates(self._config, first_decimation(self._config, size))
        return make_encoder(self._config, rates, size=size, preset=preset)
