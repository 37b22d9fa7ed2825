"""The cost of a detector beside the bare onnxruntime call: `python -m bench detector`.

Both run in turn on the same image, and the median of the ratios of neighbours is shown: a busy machine slows both
alike.
"""

import statistics
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from bench.bars import measured
from bench.support.material import data
from bench.support.processes import ms
from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import OnnxDetector
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_models.detectors.motion import MotionDetector

MODELS = (
    ("yolox_nano", (416, 416), 150),
    ("yolov5su_visdrone_640", (640, 640), 15),
    ("yolov5su_visdrone_736x1280", (1280, 736), 9),
)


def rows() -> list[dict]:
    picture = cv2.imread(str(data() / "visdrone/0000001_02999_d_0000005.jpg"))
    image = cv2.resize(picture, (1280, 720), interpolation=cv2.INTER_AREA)
    result = []
    for name, size, rounds in MODELS:
        ratio, bare_ms = _wrapper_against_bare(data() / f"models/{name}.onnx", image, size, rounds)
        of = f"{name} {size[0]}x{size[1]}"
        result.append(measured("bare call, ms", bare_ms, of=of))
        result.append(measured("detector / bare call", ratio, of=of))
    result.append(measured("motion detector on 1280x720, ms a call", _motion_ms(image)))
    result.append(measured("MobileNetV2 classifier, ms a crop in a batch of 8", _classifier_ms(image)))
    return result


def _wrapper_against_bare(
    path: Path, image: npt.NDArray[np.uint8], size: tuple[int, int], rounds: int
) -> tuple[float, float]:
    model = open_model(path, settings=ModelSettings(threads=2))
    detector = OnnxDetector(model, size=size)
    tensor = np.random.default_rng(0).uniform(0, 1, (1, 3, size[1], size[0])).astype(np.float32)
    for _ in range(3):
        detector.detect(image)
        model.run(tensor)
    bare, whole = [], []
    for _ in range(rounds):
        bare.append(ms(lambda: model.run(tensor)))
        whole.append(ms(lambda: detector.detect(image)))
    return statistics.median(w / b for w, b in zip(whole, bare, strict=True)), statistics.median(bare)


def _motion_ms(image: npt.NDArray[np.uint8]) -> float:
    detector = MotionDetector()
    shifts = [np.float32([[1, 0, 3 * i], [0, 1, i]]) for i in range(16)]
    images = [cv2.warpAffine(image, shift, (1280, 720), borderMode=cv2.BORDER_REFLECT) for shift in shifts]
    return statistics.median([ms(lambda i=i: detector.detect(i)) for i in images][7:])


def _classifier_ms(image: npt.NDArray[np.uint8]) -> float:
    classifier = open_classifier(str(data() / "models/mobilenet_v2_imagenet.onnx"))
    crops = [image[100 : 160 + 8 * i, 200 : 300 + 10 * i] for i in range(8)]
    classifier.classify(crops)
    return statistics.median(ms(lambda: classifier.classify(crops)) for _ in range(8)) / 8
