"""Small folders in the layouts of the three public sets that the embedded models learn from."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

HIT_CLASSES = ("Person", "Car", "Bicycle", "OtherVehicle", "DontCare")


def write_yolo(
    folder: Path, pictures: dict[str, Sequence[tuple[int, float, float, float, float]]], *, side: int = 640
) -> None:
    """``images/NAME.jpg`` of noise and ``labels/NAME.txt``: class, x1, y1, x2, y2 in pixels become YOLO's lines."""
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    rng = np.random.default_rng(1)
    for name, boxes in pictures.items():
        image = rng.integers(60, 160, (side // 8, side // 8, 3), np.uint8)
        image = np.asarray(cv2.resize(image, (side, side)))
        lines = []
        for kind, x1, y1, x2, y2 in boxes:
            cv2.rectangle(image, (round(x1), round(y1)), (round(x2) - 1, round(y2) - 1), (240, 240, 240), -1)
            middle = (x1 + x2) / 2 / side, (y1 + y2) / 2 / side
            lines.append(
                f"{kind} {middle[0]:.8f} {middle[1]:.8f} {(x2 - x1) / side:.8f} {(y2 - y1) / side:.8f}\n"
            )
        cv2.imwrite(str(folder / "images" / f"{name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        (folder / "labels" / f"{name}.txt").write_text("".join(lines))


def write_hit(folder: Path, dates: Sequence[str]) -> None:
    """HIT-UAV as published: a thermal picture of each date, in turn in train, val and test, with one box a class."""
    (folder / "annotations").mkdir(parents=True)
    for start, part in enumerate(("train", "val", "test")):
        (folder / part).mkdir()
        images, rows = [], []
        for number, date in list(enumerate(dates))[start::3]:
            name = f"1_80_90_0_{number:05d}.jpg"
            grey = np.random.default_rng(number).integers(40, 90, (512, 640), np.uint8)
            images.append(
                {"filename": name, "height": 512, "width": 640, "id": number, "date_captured": date}
            )
            for kind in range(len(HIT_CLASSES)):
                box = [20 + 120 * kind, 100, 40, 24]
                grey[box[1] : box[1] + box[3], box[0] : box[0] + box[2]] = 230
                rows.append({"image_id": number, "category_id": kind, "bbox": box, "id": len(rows)})
            cv2.imwrite(str(folder / part / name), grey)
        kinds = [{"id": kind, "name": name} for kind, name in enumerate(HIT_CLASSES)]
        about = {"images": images, "annotation": rows, "categories": kinds}
        (folder / "annotations" / f"{part}.json").write_text(json.dumps(about))
