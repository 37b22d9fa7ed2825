"""Real labelled pictures for the pool: five public sets, each with its labels and its omissions.

Every picture goes through x265 at 80 to 1400 kbps (of a 1280x720 base) or stays clean, and is kept as one file of the
pool. ``class_ids`` beyond the classes: -1 is neither object nor background, `LARGE_VEHICLE` is a van,
truck or bus: the set does not tell which.
"""

import csv
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Image
from hvt_train.pictures.camera import Teachers, agreed, unlabelled, without_what_stands
from hvt_train.pictures.kinds import ID as _ID
from hvt_train.pictures.kinds import LARGE_VEHICLE
from hvt_train.pictures.places import Picture
from hvt_train.pictures.pool import BASE_SIZE, in_flight, save_picture, thin_kbps

_KIT = (_ID["car"], _ID["truck"], _ID["bus"], _ID["van"])
_HIT = (_ID["pedestrian"], _ID["car"], _ID["bicycle"], LARGE_VEHICLE, -1)
_WATER = (_ID["pedestrian"], _ID["boat"], _ID["boat"], -1, -1)
_HIT_JUDGES = {"20210115", "20210123"}
_HIT_HELD_OUT = {"20210114", "20210119"}
_KIT_HELD_OUT = "MunichStreet02"
_WATER_HELD_OUT_FROM = {"seq00": 300, "seq03": 14010}
_CODED_SHARE = 0.65
_CODED_SHARE_SMALL = 0.5
_WIDEST_PX = 1600
_BORDER_PX = 26  # Madison leaves out vehicles that the border cuts
_LARGE_PX = 128  # a car is 96 pixels long there, one in twenty vehicles longer than 118


@dataclass(frozen=True, slots=True)
class HeldOut:
    """A picture as the detector gets it, with its labels."""

    image_bgr: Image
    boxes_px: npt.NDArray[np.float32]
    ignored_px: npt.NDArray[np.float32]
    """(M, 4); boxes on them count neither way."""
    judged: frozenset[str]
    """Class names that the picture labels; boxes of others count neither way."""


_Labelled = tuple[Path, npt.NDArray[np.float32], npt.NDArray[np.int32]]


def fill_real(folder: Path, data: Path, *, seed: int = 1, teachers: Teachers | None = None) -> list[Path]:
    """Put the sets that lie under ``data`` (``kit_ais``, ``hit_uav``, ``cats_madison`` …) into the pool ``folder``.

    Flights and sequences that are held out for measuring are left out. Files that are there already stay. With
    ``teachers`` the clips of ``street`` and the pictures of ``camera`` too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, read in SETS.items():
        for number, (path, boxes, kinds) in enumerate(read(data)):
            target = folder / f"{name}-{number:05d}.npz"
            written.append(target)
            if not target.exists():
                rng = np.random.default_rng([seed, number])
                loaded = cv2.imread(str(path))
                assert loaded is not None, path
                image, scale = np.asarray(loaded, np.uint8), min(1.0, _WIDEST_PX / loaded.shape[1])
                if scale < 1:
                    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                    image = np.asarray(small, np.uint8)
                if rng.random() < _CODED_SHARE:
                    image = _coded(image, rng)
                high, wide = image.shape[:2]
                inside = (boxes * scale).clip(0, (wide, high, wide, high)).astype(np.float32)
                save_picture(target, Picture(image, inside, kinds, np.ones(len(kinds), np.float32)))
    if teachers is not None:
        for name in ("street", "camera"):
            written += _named(folder, data / name, name, teachers)
    return written


def _named(folder: Path, data: Path, kind: str, teachers: Teachers) -> list[Path]:
    """Pictures and clips that teachers name; those of traffic cameras begin with the camera's name and a dash."""
    pictures = [*unlabelled(data)]
    targets = [folder / f"{kind}-{number:05d}.npz" for number in range(len(pictures))]
    if all(target.exists() for target in targets):
        return targets
    said = [teachers.say(image) for _, image in pictures]
    if kind == "camera":
        cameras: dict[str, list[int]] = {}
        for number, (name, _) in enumerate(pictures):
            cameras.setdefault(name.split("-")[0], []).append(number)
        for numbers in cameras.values():
            moving = without_what_stands([said[number] for number in numbers])
            for number, left in zip(numbers, moving, strict=True):
                said[number] = left
    for number, ((_, image), target) in enumerate(zip(pictures, targets, strict=True)):
        boxes, kinds = agreed(said[number], area_px=image.shape[0] * image.shape[1])
        rng = np.random.default_rng([9, number])
        seen = image
        if rng.random() < _CODED_SHARE_SMALL:
            share = max(0.5, image.shape[0] * image.shape[1] / (640 * 480))
            seen = in_flight(image, rng, kbps=share * float(np.exp(rng.uniform(np.log(120), np.log(900)))))
        save_picture(target, Picture(seen, boxes, kinds, np.ones(len(kinds), np.float32)))
    return targets


def _coded(image: Image, rng: np.random.Generator) -> Image:
    """After x265 at about the bits a pixel of a thin base."""
    kbps = thin_kbps(rng)
    share = image.shape[0] * image.shape[1] / (BASE_SIZE[0] * BASE_SIZE[1]) * float(rng.uniform(0.7, 1.5))
    return in_flight(image, rng, kbps=max(20.0, kbps * share))


def _yolo(path: Path, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """(N, 5): class, x1, y1, x2, y2 in pixels."""
    rows = np.array([line.split()[:5] for line in path.read_text().splitlines() if line.strip()], float)
    rows = rows.reshape(-1, 5)
    middle, sides = rows[:, 1:3] * size, rows[:, 3:5] * size
    return np.hstack([rows[:, :1], middle - sides / 2, middle + sides / 2])


def _pairs(root: Path) -> Iterator[tuple[Path, npt.NDArray[np.float64]]]:
    for path in sorted((root / "images").glob("*.jpg")):
        label = root / "labels" / f"{path.stem}.txt"
        image = cv2.imread(str(path))
        if image is not None and label.is_file():
            yield path, _yolo(label, (image.shape[1], image.shape[0]))


def _kit(data: Path, *, held_out: bool = False) -> Iterator[_Labelled]:
    """KIT AIS: all vehicles. A person there is three pixels long, too small to be asked for."""
    for path, rows in _pairs(data / "kit_ais"):
        if path.name.startswith(_KIT_HELD_OUT) == held_out:
            yield path, rows[:, 1:].astype(np.float32), np.array([_KIT[int(k)] for k in rows[:, 0]], np.int32)


def _thermal(data: Path, *, held_out: bool = False) -> Iterator[_Labelled]:
    """HIT-UAV: everything is labelled. The flights that judge, and those held out, are left out by date."""
    for part in ("train", "val", "test"):
        about = json.loads((data / "hit_uav" / "annotations" / f"{part}.json").read_text())
        boxes: dict[int, list[list[float]]] = {}
        for row in about["annotation"]:
            boxes.setdefault(row["image_id"], []).append([row["category_id"], *row["bbox"]])
        for picture in about["images"]:
            date = picture["date_captured"]
            if date in _HIT_JUDGES or (date in _HIT_HELD_OUT) != held_out:
                continue
            rows = np.array(boxes.get(picture["id"], []), np.float32).reshape(-1, 5)
            corners = np.hstack([rows[:, 1:3], rows[:, 1:3] + rows[:, 3:5]])
            kinds = np.array([_HIT[int(k)] for k in rows[:, 0]], np.int32)
            yield data / "hit_uav" / part / picture["filename"], corners, kinds


def _marks(table: str, **kinds: int) -> dict[str, list[list[float]]]:
    """Kind, x1, y1, x2, y2 of our own marks, by picture; kinds that are not named count neither way."""
    marks: dict[str, list[list[float]]] = {}
    with resources.files("hvt_train.pictures").joinpath(table).open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            box = [float(row[name]) for name in ("x1", "y1", "x2", "y2")]
            marks.setdefault(row["file"], []).append([kinds.get(row["kind"], -1), *box])
    return marks


def _road(data: Path) -> Iterator[_Labelled]:
    """Madison: vehicles, the small ones as cars, and the people that we marked (``madison_people.csv``).

    Only pictures of views that hover long enough to tell moving objects are taken: there, walking people are marked.
    """
    marks = _marks("madison_people.csv", person=_ID["pedestrian"])
    for path, rows in _pairs(data / "cats_madison"):
        if path.name not in marks:
            continue
        high, wide = 640, 640
        vehicles = rows[:, 1:]
        longest = (vehicles[:, 2:] - vehicles[:, :2]).max(1, initial=0) if len(vehicles) else np.zeros(0)
        kinds = [LARGE_VEHICLE if side > _LARGE_PX else _ID["car"] for side in longest]
        people = [row for row in marks[path.name] if row[3] > 0]
        edge = [[0, 0, wide, _BORDER_PX], [0, high - _BORDER_PX, wide, high]]
        edge += [[0, 0, _BORDER_PX, high], [wide - _BORDER_PX, 0, wide, high]]
        boxes = np.array([*vehicles.tolist(), *[row[1:] for row in people], *edge], np.float32)
        yield path, boxes, np.array([*kinds, *[row[0] for row in people], -1, -1, -1, -1], np.int32)


def _water(data: Path, *, held_out: bool = False) -> Iterator[_Labelled]:
    """SeaDronesSee: people and boats, jet skis among them; buoys are neither. The end of a flight is held out."""
    for path, rows in _pairs(data / "seadronessee"):
        flight, number = path.stem.split("_")
        if (int(number) >= _WATER_HELD_OUT_FROM.get(flight, 1 << 30)) == held_out:
            yield (
                path,
                rows[:, 1:].astype(np.float32),
                np.array([_WATER[int(k)] for k in rows[:, 0]], np.int32),
            )


def _field(data: Path) -> Iterator[_Labelled]:
    """Woods, stones, shores and fields straight down: nothing but the cars of ``field_vehicles.csv`` is there."""
    marks = _marks("field_vehicles.csv", car=_ID["car"])
    for path in sorted((data / "field").glob("*.[jJ][pP][gG]")):
        rows = np.array(marks.get(path.name, []), np.float32).reshape(-1, 5)
        yield path, rows[:, 1:], rows[:, 0].astype(np.int32)


def held_out_labelled(data: Path, *, every: int = 4) -> Iterator[Picture]:
    """Every n-th picture that training never sees, as it is, with classes as in the pool."""
    for read in (_kit, _thermal):
        for path, boxes, kinds in list(read(data, held_out=True))[::every]:
            image = cv2.imread(str(path))
            assert image is not None, path
            yield Picture(np.asarray(image, np.uint8), boxes, kinds, np.ones(len(kinds), np.float32))


def held_out_pictures(data: Path) -> Iterator[HeldOut]:
    """Flights and sequences that training never sees, as the base stream would show them."""
    vehicles = frozenset({"car", "van", "truck", "bus"})
    sets = ((_kit, vehicles, 3), (_thermal, vehicles | {"pedestrian", "bicycle"}, 4))
    for read, judged, every in sets:
        for path, boxes, kinds in list(read(data, held_out=True))[::every]:
            image = cv2.imread(str(path))
            assert image is not None, path
            scale = min(BASE_SIZE[0] / image.shape[1], BASE_SIZE[1] / image.shape[0])
            how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
            base = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=how), np.uint8)
            yield HeldOut(base, boxes[kinds != -1] * scale, boxes[kinds == -1] * scale, judged)


SETS: dict[str, Callable[[Path], Iterator[_Labelled]]] = {
    "kit": _kit,
    "thermal": _thermal,
    "road": _road,
    "water": _water,
    "field": _field,
}
