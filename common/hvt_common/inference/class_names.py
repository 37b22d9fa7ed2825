"""Which class words of detectors, classifiers and people mean the same kind of thing.

A *kind* is the word in which classes of different models are compared: ``car``, ``truck``, ``bus``, ``person``,
``motor``, ``bicycle``, ``tricycle``, ``train``, ``boat``, ``aeroplane``.

========  ==========  =========================  =====  ================================
kind      COCO        VisDrone                   UAVDT  ImageNet (first synonyms)
========  ==========  =========================  =====  ================================
car       car         car, van                   car    minivan, sports car, jeep, cab …
truck     truck       truck                      truck  pickup, moving van, tow truck …
bus       bus         bus                        bus    minibus, school bus, trolleybus
person    person      pedestrian, people         none   none
motor     motorcycle  motor                      none   moped, motor scooter
bicycle   bicycle     bicycle                    none   mountain bike, tandem
tricycle  none        tricycle, awning-tricycle  none   tricycle, jinrikisha
========  ==========  =========================  =====  ================================

A van is a car here, as in the pilot's class list (car, truck, bus, person), which was drawn up for COCO, where vans
are labelled car. The motion detector's only class, ``moving``, may be any kind and passes every class list.
A name that no row holds is a kind of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

__all__ = ["COCO_NAMES", "MOVING", "VISDRONE_NAMES", "ids_of_kinds", "kind_of", "same_kind"]

MOVING = "moving"
"""The class of what moves, whatever it is."""

COCO_NAMES: tuple[str, ...] = tuple(
    """person, bicycle, car, motorcycle, airplane, bus, train, truck, boat, traffic light, fire hydrant, stop sign,
    parking meter, bench, bird, cat, dog, horse, sheep, cow, elephant, bear, zebra, giraffe, backpack, umbrella,
    handbag, tie, suitcase, frisbee, skis, snowboard, sports ball, kite, baseball bat, baseball glove, skateboard,
    surfboard, tennis racket, bottle, wine glass, cup, fork, knife, spoon, bowl, banana, apple, sandwich, orange,
    broccoli, carrot, hot dog, pizza, donut, cake, chair, couch, potted plant, bed, dining table, toilet, tv, laptop,
    mouse, remote, keyboard, cell phone, microwave, oven, toaster, sink, refrigerator, book, clock, vase, scissors,
    teddy bear, hair drier, toothbrush""".replace("\n    ", " ").split(", ")
)
"""The 80 classes of COCO detection in the order of every YOLO."""

VISDRONE_NAMES: tuple[str, ...] = (
    "pedestrian",
    "people",
    "bicycle",
    "car",
    "van",
    "truck",
    "tricycle",
    "awning-tricycle",
    "bus",
    "motor",
)
"""The 10 classes of VisDrone-DET, categories 1 to 10 of its annotations."""

_NAMES_OF_KIND: Mapping[str, tuple[str, ...]] = {
    "car": (
        "car",
        "van",
        "auto",
        "automobile",
        # ImageNet; "passenger car" there is a railway coach, and "freight car" too.
        "ambulance",
        "beach wagon",
        "cab",
        "convertible",
        "golfcart",
        "jeep",
        "limousine",
        "minivan",
        "model t",
        "police van",
        "racer",
        "sports car",
    ),
    "truck": (
        "truck",
        "lorry",
        "fire engine",
        "garbage truck",
        "moving van",
        "pickup",
        "recreational vehicle",
        "snowplow",
        "tow truck",
        "tractor",
        "trailer truck",
    ),
    "bus": ("bus", "coach", "minibus", "school bus", "trolleybus"),
    "person": ("person", "pedestrian", "people", "human"),
    "motor": ("motor", "motorcycle", "motorbike", "moped", "motor scooter"),
    "bicycle": ("bicycle", "bike", "cyclist", "bicycle-built-for-two", "mountain bike"),
    "tricycle": ("tricycle", "awning-tricycle", "jinrikisha"),
    "train": (
        "train",
        "bullet train",
        "electric locomotive",
        "freight car",
        "passenger car",
        "steam locomotive",
        "streetcar",
    ),
    "boat": (
        "boat",
        "ship",
        "canoe",
        "catamaran",
        "container ship",
        "fireboat",
        "gondola",
        "lifeboat",
        "liner",
        "speedboat",
        "trimaran",
        "yawl",
    ),
    "aeroplane": ("aeroplane", "airplane", "aircraft", "airliner", "warplane"),
}
_KIND_OF_NAME: Mapping[str, str] = {name: kind for kind, names in _NAMES_OF_KIND.items() for name in names}


def kind_of(name: str) -> str:
    """The kind that a class name means; the plain name itself where no row of the table holds it.

    Case, and the synonyms that ImageNet writes after a comma, do not matter: ``Beach wagon, station wagon`` is a car.
    """
    plain = name.partition(",")[0].strip().casefold()
    return _KIND_OF_NAME.get(plain, plain)


def same_kind(name: str, wanted: str) -> bool:
    """Whether both words mean the same kind; what moves may be anything."""
    kinds = kind_of(name), kind_of(wanted)
    return kinds[0] == kinds[1] or MOVING in kinds


def ids_of_kinds(class_names: Iterable[str], wanted: Iterable[str]) -> frozenset[int]:
    """The indices of those class names that are of any wanted kind."""
    words = tuple(wanted)
    return frozenset(
        index for index, name in enumerate(class_names) if any(same_kind(name, word) for word in words)
    )
