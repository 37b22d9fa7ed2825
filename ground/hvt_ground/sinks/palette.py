"""Colours: one for each kind of object, one for each line of a plot.

The base is the palette of Okabe and Ito ("Color Universal Design", 2008), which stays distinct for the common
forms of colour blindness; its black and its dark blue are left out or lightened, because the screen is dark.
"""

from __future__ import annotations

import re
import zlib
from functools import lru_cache

Rgb = tuple[int, int, int]
"""Red, green, blue, 0…255."""

SKY: Rgb = (86, 180, 233)
AMBER: Rgb = (240, 173, 30)
GREEN: Rgb = (0, 190, 140)
YELLOW: Rgb = (240, 228, 66)
BLUE: Rgb = (76, 140, 245)
VERMILLION: Rgb = (232, 104, 40)
PINK: Rgb = (222, 135, 180)
GREY: Rgb = (170, 176, 184)
WHITE: Rgb = (235, 238, 242)

# The first pattern that is found in a class name decides. The names are those of VisDrone, UAVDT, COCO and the
# vehicles of ImageNet, so that "van" of a detector and "minivan" of a classifier look alike.
_FAMILIES: tuple[tuple[str, Rgb], ...] = (
    (r"^(other|background|nothing|something)$", GREY),
    (r"pedestrian|people|person|rider", PINK),
    (r"tricycle|rickshaw", YELLOW),
    (r"motor|moped|scooter", (190, 160, 255)),
    (r"bicycle|bike", GREEN),
    (r"bus|trolley|train|tram", BLUE),
    (r"van\b|minibus|ambulance", AMBER),
    (r"truck|lorry|trailer|tow|garbage|fire engine|tractor|pickup", VERMILLION),
    (r"car\b|cab\b|taxi|limousine|convertible|wagon|racer|jeep|vehicle|model t", SKY),
)
_REST: tuple[Rgb, ...] = (GREEN, YELLOW, PINK, BLUE, (190, 160, 255), (130, 205, 190), (205, 185, 130))


@lru_cache(maxsize=4096)
def class_colour(name: str) -> Rgb:
    """The colour of a class by its name; the same name has the same colour in every recording."""
    lowered = name.lower()
    for pattern, colour in _FAMILIES:
        if re.search(pattern, lowered):
            return colour
    return _REST[zlib.crc32(lowered.encode()) % len(_REST)]


def dimmed(colour: Rgb, *, share: float) -> Rgb:
    """The colour nearer to black: ``share`` of its brightness."""
    red, green, blue = (round(channel * share) for channel in colour)
    return red, green, blue
