"""Which head a network has: as the user says, else as its file says, else as all its outputs together prove."""

from __future__ import annotations

from hvt_common.errors import UserError
from hvt_common.inference.heads.contract import Head
from hvt_common.inference.heads.kind import YOLOX, Kind, Match
from hvt_common.inference.heads.trial import Trial
from hvt_common.inference.store import MISSING, library_part, needed_part

HEAD_NAMES = (
    "yolox",
    "yolox-decoded",
    "yolov5",
    "yolov6",
    "yolov8",
    "yolov8-rows",
    "end-to-end",
    "yolov7-rows",
    "yolo-nas",
    "nas-rows",
    "nms-lists",
    "rt-detr",
    "rt-detr-rows",
    "rf-detr",
    "labels-boxes-scores",
    "ssd",
    "atss",
    "tf-lists",
)
"""The values of ``--head``; all but the first are of the model library, and ``--help`` is not to load it."""
_RT_DETR = ("rt-detr-rows", "rt-detr")
_RAW_AXES = 5
"""(1, 3, H, W, 5+C): YOLOv5's levels, beside all of them decoded."""


def check_head_name(name: str | None) -> None:
    """`UserError` for a name that no head has."""
    if name is not None and name not in HEAD_NAMES:
        raise UserError(f"--head '{name}' is not known: choose one of {', '.join(HEAD_NAMES)}")


def choose_head(trial: Trial, *, wanted: str | None = None) -> Head:
    """The head that the outputs belong to; ``wanted`` is as of ``--head``.

    Raises:
        UserError: the half sentence that says why none is certain, and what decides it.
    """
    check_head_name(wanted)
    said = trial.metadata.get("head", "")
    if wanted is not None or said in HEAD_NAMES:
        return _named(trial, wanted or said, "--head" if wanted else "its metadata: head")
    library = library_part("heads")
    kinds: dict[str, Kind] = {"yolox": YOLOX} if library is None else dict(library)
    why = ""
    if library is not None and _says_rt_detr(trial):
        kinds = {name: kinds[name] for name in _RT_DETR}
        why = f"its metadata say {'head ' + said if said else 'RT-DETR'}: "
    found = {name: match for name, kind in kinds.items() if (match := kind.fits(trial)) is not None}
    certain = {name: match for name, match in found.items() if match.proof and _explains(trial, match)}
    if not certain and why:
        certain = found
    if len(certain) == 1:
        ((name, match),) = certain.items()
        return kinds[name].head(name, match, why + (match.proof or "its shape fits"))
    if not found:
        more = "" if library is not None else f"; of other heads, {MISSING}"
        raise UserError(f"its outputs fit no head that is known{more}")
    likely = [name for name, match in found.items() if match.possible and _explains(trial, match)]
    could = " or ".join(certain or likely or found)
    raise UserError(f"its outputs could be {could}, which --head NAME decides")


def _named(trial: Trial, name: str, by: str) -> Head:
    kind: Kind = YOLOX if name == "yolox" else needed_part("heads", f"head {name}")[name]
    match = kind.fits(trial)
    if match is None:
        raise UserError(f"its outputs are not those of {by} {name}, which is {kind.text}")
    return kind.head(name, match, f"{by} {name}")


def _says_rt_detr(trial: Trial) -> bool:
    # Whether ``head``, or in older files ``description``, says RT-DETR, as Ultralytics writes it.
    said = trial.metadata.get("head", "") + trial.metadata.get("description", "")
    return "rtdetr" in said.lower().replace("-", "")


def _explains(trial: Trial, match: Match) -> bool:
    # Whether every other output is the head's too: raw levels, or a second branch of the same shape.
    if match.by_name:
        return True
    shapes = {trial.shape(index) for index in match.outputs}
    rest = set(range(len(trial.ports))) - set(match.outputs)
    return all(len(trial.shape(index)) == _RAW_AXES or trial.shape(index) in shapes for index in rest)
