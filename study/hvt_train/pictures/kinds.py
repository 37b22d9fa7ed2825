"""The classes of ``aerial-nano``, and the choices that a set may leave open."""

from hvt_scene.drawing.vehicles import CLASS_NAMES

CLASSES = (*CLASS_NAMES, "boat", "bicycle")
"""Those of the drawn scenes come first: their class ids are these."""
ID = {name: number for number, name in enumerate(CLASSES)}

LARGE_VEHICLE, VEHICLE, BIKE = -2, -3, -4
"""Class ids of pools: the set does not tell which of `AMONG` it is. -1 is neither object nor background."""
AMONG = {
    LARGE_VEHICLE: {ID["van"]: 0.0, ID["truck"]: 0.5, ID["bus"]: 0.5},
    VEHICLE: {ID["car"]: 1.0, ID["van"]: 0.0, ID["truck"]: 0.0, ID["bus"]: 0.0},
    BIKE: {ID["motor"]: 0.5, ID["bicycle"]: 0.0},
}
"""The classes that it may be, and how much (in logits) each is favoured."""
