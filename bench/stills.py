"""``make bench-stills``: the bytes of a still in each codec at equal quality, on real crops.

Crops are boxes of the VisDrone detector on drone_carpark; residuals build on base streams of 400 and 800 kbps. Every
codec codes every crop at each step of a ladder. Bytes at equal Y-PSNR are read off crop by crop at the Y-PSNR of
Pillow's JPEG q65 (optimised Huffman tables, the paper's still); bytes at equal KL where the mean over crops of
KL(answer on the pristine crop || answer on the still) is that of JPEG q65, with MobileNetV2. Between two steps the
line is straight in the logarithm of bytes.
"""

import io
import json
import random
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.support.material import FPS, SIZE, data, frames
from hvt_common.inference.classify import Classifier, open_classifier
from hvt_common.inference.detect import open_detector
from hvt_common.values import Image, View
from hvt_common.video.base_crop import MAX_SIDE_PX, base_crop, coded_size
from hvt_common.video.hevc import BaseDecoder
from hvt_common.video.still_codecs import StillCodec, psnr_y_db, still_codec, still_codec_names
from hvt_edge.perception.candidates import PADDING, crop_box
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from hvt_study.report.data.pairs import needed_bps

KBPS = (800, 400)
TAKEN = range(12, 150, 18)
"""Frames whose boxes are cropped out, by index."""
BOXES_A_FRAME = 26
JUDGED_EVERY = 3
"""The classifier sees every third crop."""
LADDER = (1, 10, 20, 30, 42, 54, 65, 76, 87, 98)
BARS = {"h264-intra": 0.60, "residual at 800 kbps": 0.25, "residual at 400 kbps": 0.40}
SPEED_BAR_MS = 2.0


@dataclass(frozen=True)
class Pair:
    """A crop of the source and the same part of the base, in the same pixels."""

    crop_bgr: Image
    base_bgr: Image


@dataclass(frozen=True)
class Point:
    """All crops at one step: bytes and Y-PSNR a crop, and the mean KL of those that the classifier saw."""

    sizes: list[int]
    psnr_db: list[float]
    kl_nats: float


@dataclass(frozen=True)
class Score:
    """One line of the table; ratios are to Pillow's JPEG q65."""

    name: str
    at_psnr: float
    at_kl: float | None
    encode_ms: float
    decode_ms: float


class Judge:
    """How far the classifier's answers on stills are from those on the pristine crops."""

    def __init__(self, classifier: Classifier, crops: list[Image]) -> None:
        self._classifier = classifier
        self._wanted = self._answers(crops)

    def kl_nats(self, images: list[Image]) -> float:
        given = self._answers(images)
        return float(np.mean(np.sum(self._wanted * np.log(self._wanted / given), axis=1)))

    def _answers(self, images: list[Image]) -> np.ndarray:
        answers = [posterior.probabilities for posterior in self._classifier.classify(images[::JUDGED_EVERY])]
        return np.maximum(np.stack(answers).astype(np.float64), 1e-9)


def pairs() -> dict[int, list[Pair]]:
    """The same crops with the base of each rate, about 200."""
    taken = frames(TAKEN.stop)
    source_size = (taken[0].source_bgr.shape[1], taken[0].source_bgr.shape[0])
    view = View.fitted(source_size, SIZE, fit="letterbox")
    boxes = _boxes(taken, view)
    result = {}
    for kbps in KBPS:
        encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=FPS, bitrate_bps=kbps * 1000))
        decoder = BaseDecoder()
        result[kbps] = []
        for frame in taken:
            seen = decoder.decode(encoder.encode(frame, keyframe=frame.index == 0).data)
            for box in boxes.get(frame.index, ()):
                crop_px = crop_box(box, padding=PADDING, source_size=source_size)
                size = coded_size(crop_px, max_side_px=MAX_SIDE_PX)
                crop = base_crop(
                    frame.source_bgr, view=_identity(source_size), crop_source_px=crop_px, size=size
                )
                base = base_crop(seen, view=view, crop_source_px=crop_px, size=size)
                result[kbps].append(Pair(crop, base))
    return result


def scores() -> tuple[list[Score], str]:
    """The table, and a sentence about the crops."""
    material = pairs()
    crops = [pair.crop_bgr for pair in material[KBPS[0]]]
    judge = Judge(open_classifier(str(data() / "models/mobilenet_v2_imagenet.onnx")), crops)
    paper, theirs = [_pillow(crop) for crop in crops], []
    for payload in paper:
        theirs.append(still_codec("jpeg").decode(payload, size=_size(crops[len(theirs)])))
    reference = _point([len(payload) for payload in paper], theirs, crops, judge)
    lines = []
    for name in still_codec_names():
        codec = still_codec(name)
        for kbps in KBPS if codec.needs_base else KBPS[:1]:
            label = f"{name} at {kbps} kbps" if codec.needs_base else name
            lines.append(_score(label, codec, material[kbps], reference, judge))
    bytes_each, mean_db = statistics.mean(reference.sizes), statistics.mean(reference.psnr_db)
    said = [
        f"{len(crops)} crops; JPEG q65: {bytes_each:.0f} bytes, {mean_db:.2f} dB, KL {reference.kl_nats:.3f}"
    ]
    for kbps in KBPS:
        bases = [pair.base_bgr for pair in material[kbps]]
        base = _point([0] * len(bases), bases, crops, judge)
        said.append(f"base at {kbps} kbps: {statistics.mean(base.psnr_db):.2f} dB, KL {base.kl_nats:.3f}")
    return lines, "; ".join(said)


def rows() -> list[dict[str, object]]:
    """One row a measure, as ``make bench`` shows them."""
    return [row for score in scores()[0] for row in _rows(score)]


def _rows(score: Score) -> list[dict[str, object]]:
    bar = BARS.get(score.name)
    timed = SPEED_BAR_MS if score.name.startswith(("residual", "h264")) else None
    found = [
        ("bytes at equal Y-PSNR / JPEG q65", score.at_psnr, bar),
        ("bytes at equal KL / JPEG q65", score.at_kl, None),
        ("encode, ms a crop", score.encode_ms, timed),
        ("decode, ms a crop", score.decode_ms, timed),
    ]
    return [
        {
            "measure": f"{score.name}: {measure}",
            "value": None if value is None else round(value, 3),
            "bar": most,
            "holds": None if most is None or value is None else value <= most,
        }
        for measure, value, most in found
    ]


def _score(label: str, codec: StillCodec, material: list[Pair], reference: Point, judge: Judge) -> Score:
    encode_s, decode_s, points = [], [], []
    for quality_pct in LADDER:
        sizes, images = [], []
        for pair in material:
            base = pair.base_bgr if codec.needs_base else None
            began = time.perf_counter()
            coded = codec.encode(pair.crop_bgr, quality_pct=quality_pct, base_bgr=base)
            between = time.perf_counter()
            image = codec.decode(
                coded.data, size=_size(pair.crop_bgr), parameters=coded.parameters, base_bgr=base
            )
            decode_s.append(time.perf_counter() - between)
            encode_s.append(between - began)
            sizes.append(len(coded.data))
            images.append(image)
        points.append(_point(sizes, images, [pair.crop_bgr for pair in material], judge))
    total = 0.0
    for index, target_db in enumerate(reference.psnr_db):
        line = [(point.psnr_db[index], point.sizes[index]) for point in points]
        total += _crossing(line, target_db)
    means = [(-point.kl_nats, statistics.mean(point.sizes)) for point in points]
    reached = means[-1][0] >= -reference.kl_nats
    at_kl = _crossing(means, -reference.kl_nats) / statistics.mean(reference.sizes) if reached else None
    return Score(
        name=label,
        at_psnr=total / sum(reference.sizes),
        at_kl=at_kl,
        encode_ms=statistics.median(encode_s) * 1e3,
        decode_ms=statistics.median(decode_s) * 1e3,
    )


def _crossing(line: list[tuple[float, float]], target: float) -> float:
    """Bytes where quality, the first of each point, first reaches the target; the ends are not stretched."""
    reached = needed_bps([(size, quality) for quality, size in line], level=target)
    return min(max(reached, line[0][1]), line[-1][1])


def _point(sizes: list[int], images: list[Image], crops: list[Image], judge: Judge) -> Point:
    psnr_db = [min(99.0, psnr_y_db(image, crop)) for image, crop in zip(images, crops, strict=True)]
    return Point(sizes, psnr_db, judge.kl_nats(images))


def _boxes(taken, view: View) -> dict[int, list[tuple[float, float, float, float]]]:
    detector = open_detector(str(data() / "models/yolov5su_visdrone_640.onnx"), provider="cpu")
    choice = random.Random(1)
    result = {}
    for index in TAKEN:
        seen = detector.detect(taken[index].base_bgr)
        sure = [at for at in range(len(seen)) if seen.confidences[at] > 0.3]
        some = choice.sample(sure, min(BOXES_A_FRAME, len(sure)))
        result[index] = [tuple(map(float, box)) for box in view.to_source(seen.boxes_xyxy_px[sorted(some)])]
    return result


def _identity(size: tuple[int, int]) -> View:
    return View(source_size=size, base_size=size, scale=1.0, offset_px=(0.0, 0.0))


def _size(image: Image) -> tuple[int, int]:
    return image.shape[1], image.shape[0]


def _pillow(crop_bgr: Image) -> bytes:
    from PIL import Image as Pillow  # noqa: PLC0415 - only the peer needs it

    buffer = io.BytesIO()
    Pillow.fromarray(np.ascontiguousarray(crop_bgr[..., ::-1])).save(
        buffer, "JPEG", quality=65, optimize=True
    )
    return buffer.getvalue()


def main() -> int:
    console = Console(highlight=False)
    began = time.perf_counter()
    with console.status("stills …"):
        lines, said = scores()
    table = Table(title="make bench-stills", title_justify="left", caption=said, caption_justify="left")
    heads = ("codec", "bytes at equal Y-PSNR", "at most", "at equal KL", "encode ms", "decode ms")
    for head in heads:
        table.add_column(head, justify="left" if head == "codec" else "right")
    table.add_row("jpeg q65 of Pillow", "1.000", "", "1.000", "", "")
    for line in lines:
        bar = BARS.get(line.name)
        missed = "" if bar is None or line.at_psnr <= bar else " MISSED"
        at_kl = "not reached" if line.at_kl is None else f"{line.at_kl:.3f}"
        shown = (f"{line.at_psnr:.3f}{missed}", "" if bar is None else f"{bar:.2f}", at_kl)
        table.add_row(line.name, *shown, f"{line.encode_ms:.2f}", f"{line.decode_ms:.2f}")
    console.print(table)
    console.print(f"{time.perf_counter() - began:.0f} s")
    out = Path("build/bench-stills.json")
    out.parent.mkdir(exist_ok=True)
    found = [row for line in lines for row in _rows(line)]
    out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
