"""Class names from a text file or a model's own metadata, and whether its scores are calibrated; opens no network."""

import ast
import json
import logging
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from hvt_common.errors import UserError, absent, telling
from hvt_common.files import read_text
from hvt_common.inference.class_names import COCO_NAMES, VISDRONE_NAMES
from hvt_common.inference.runtimes.model_file import metadata_of
from hvt_common.inference.runtimes.plug_in import plug_in_names, plug_in_of
from hvt_common.inference.store import MOTION, known_classes, parts_of, resolve_model
from hvt_common.units import shown_text

_log = logging.getLogger(__name__)

KNOWN_LABELS: Mapping[str, tuple[str, ...]] = {"coco": COCO_NAMES, "visdrone": VISDRONE_NAMES}
"""Names that stand for a file. A number of classes alone never means one of these."""

_NO_COCO_ID = frozenset({0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83})
_FIRST_COCO_ID = {"tf-lists": 1, "labels-boxes-scores": 0, "ssd": 0}
"""Heads that list objects by COCO's own ids, as TensorFlow, torchvision and the Open Model Zoo do."""
_BACKGROUND = ("background", "???", "n/a")
_FIRST_COCO_ID_OF = {90: 1, 91: 0}
"""By the number of classes."""
_UNNAMED = 100
"""Classes that get a number for a name where a list of objects without names does not tell how many there are."""

MAX_LABELS = 100_000
MAX_LABEL_CHARS = 200
_MAX_METADATA_CHARS = 1 << 20
_NAME = re.compile(r"[\w .&'/+-]*[^\W\d_][\w .&'/+-]*")
"""Between commas or line ends, without brackets around."""
_NUMBERED = re.compile(r"(\d+)\s*[:=,;.)\s]\s*(\S.*)")
_MARKED = re.compile(r"""(?=[-'"])(?:- +)?(['"]?)(\S.*?)\1""")
_SYNSET = re.compile(r"n\d{8}\s+")
_PLAIN_LIST = re.compile(r"\[([^][{}'\":]*[^\W\d][^][{}'\":]*)\]")
"""YAML's, without quotes."""
_PAIR = re.compile(r"""\s*(\d+)\s*[:=]\s*(['"]?)([^][{}'":=\s][^:=]*?)\2\s*""")
_OF_TABLE = re.compile(r"[\[\]{}]|:$|^names\s*:")


def read_labels(path: Path) -> tuple[str, ...]:
    """Read class names: UTF-8 text, one name a line, the first line is class 0; or one of `KNOWN_LABELS`.

    Blank lines at the end are ignored, so are spaces around a name and numbers before every name (0 or 1 and on, or
    a synset of ImageNet). A name may occur twice (ImageNet: crane). Raises `UserError` where it is missing, not
    readable, not text, empty or a table, has a blank line in the middle, or too many or too long names.
    """
    if str(path) in KNOWN_LABELS and not path.exists():
        return KNOWN_LABELS[str(path)]
    names = [line.strip() for line in _read_text(path).rstrip().splitlines()]
    if names == []:
        raise UserError(f"labels file {path} is empty; one class name a line is expected")
    if len(names) > MAX_LABELS:
        raise UserError(f"labels file {path} has {len(names)} lines; at most {MAX_LABELS} are accepted")
    for number, name in enumerate(names, start=1):
        if not name:
            raise UserError(
                f"labels file {path} has no name in line {number}; one class name a line is expected"
            )
        if len(name) > MAX_LABEL_CHARS:
            raise UserError(
                f"labels file {path} has {len(name)} characters in line {number}; at most {MAX_LABEL_CHARS} fit"
            )
        if not name.isprintable():
            raise UserError(
                f"labels file {path} is not text in line {number}; one class name a line is expected"
            )
        if _OF_TABLE.search(name):
            raise UserError(
                f"labels file {path} has {name!r:.80} in line {number}; one class name a line is expected, no table"
            )
    return _without_numbers(names)


def _without_numbers(names: Sequence[str]) -> tuple[str, ...]:
    # ``0 car``, ``1: bus`` in any order, ``- car``, ``"car"`` or ``n02084071 dog``: a mark of every line is no name.
    if all(map(_MARKED.fullmatch, names)):
        return tuple(_MARKED.sub(r"\2", name) for name in names)
    if all(map(_SYNSET.match, names)):
        return tuple(_SYNSET.sub("", name) for name in names)
    found = sorted((int(one[1]), one[2]) for one in map(_NUMBERED.fullmatch, names) if one)
    numbers = [number for number, _ in found]
    if len(names) < 2 or numbers not in (list(range(len(names))), list(range(1, len(names) + 1))):
        return tuple(names)
    return tuple(name for _, name in found)


def class_labels(path: Path, metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """The class names that a model carries, or that are known of this very file; None where there are none."""
    own = metadata_labels(metadata)
    if own is not None:
        return own
    known = known_classes(path)
    return KNOWN_LABELS.get(known.partition(",")[0].lower()) or _written_names(known)


def detector_labels(
    path: Path, names: tuple[str, ...] | None, said_by: str, *, head: str, classes: int | None, inputs: int
) -> tuple[str, ...]:
    """The names of a detector's classes: those that are known, ``said_by`` a file, or numbers, which is said.

    COCO's 80 are in a row, or have COCO's own ids, by the number of classes, else by the head of a network with so
    many inputs. Raises `UserError` where there are not as many as classes.
    """
    if names is None:
        names_it = "--labels FILE (hvt-ground: --detector-labels FILE) names them; FILE may be "
        return unnamed(path, classes or _UNNAMED, names_it + " or ".join(KNOWN_LABELS))
    if names is COCO_NAMES and said_by.startswith("labels"):
        by_head = _FIRST_COCO_ID.get(head) if inputs == 1 else None
        first = by_head if classes is None else _FIRST_COCO_ID_OF.get(classes)
        names = names if first is None else _coco_names_by_id()[first:]
    if head == "tf-lists" and names[0].strip("_").casefold() in _BACKGROUND:
        names = names[1:]  # it counts from 1
    if classes is not None and len(names) != classes:
        raise UserError(f"{said_by} has {len(names)} class names; {path} has {classes} classes")
    return names


def counts_from_one(head: str) -> bool:
    """Whether networks of this head may list no class 0, the background, whose name their names then lack."""
    return head in _FIRST_COCO_ID


def _coco_names_by_id() -> tuple[str, ...]:
    names = iter(COCO_NAMES)
    return tuple(f"class {number}" if number in _NO_COCO_ID else next(names) for number in range(91))


@cache  # once of a file: one that fails in flight is opened again and again
def unnamed(path: Path, count: int, how: str) -> tuple[str, ...]:
    """Numbers for names of a model that has none, which is said, with ``how`` to name its classes."""
    said = "%s has no class names: its classes are class 0 to class %d; %s"
    _log.warning(said, path.name, count - 1, how)
    return tuple(f"class {index}" for index in range(count))


def metadata_labels(metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """Class names that a model carries in ``names``, as Ultralytics writes it, or ``classes``.

    Each may be a list or a table by number (``{0: 'car', 1: 'bus'}``), as a Python literal, which is read without
    executing anything, or as JSON; or names between commas or line ends. Malformed text counts as none.
    """
    found = (_written_names(metadata.get(key, "")) for key in ("names", "classes"))
    return next((names for names in found if names is not None), None)


def first_synonym(label: str) -> str:
    """The first of comma-separated synonyms: ``beach wagon, station wagon, …`` is shown as ``beach wagon``."""
    return label.partition(",")[0].strip() or label


def _read_text(path: Path) -> str:
    if not path.is_file():
        state = "is not a file" if path.exists() else "does not exist"
        raise absent(path)(f"labels file {path} {state}; a text file with one class name a line is expected")
    with telling(f"labels file {path} cannot be read (", "); one class name a line is expected"):
        return read_text(path)


def _written_names(text: str) -> tuple[str, ...] | None:
    text = text.strip()
    if text in ("", "null", "None") or len(text) > _MAX_METADATA_CHARS:
        return None
    plain = _PLAIN_LIST.fullmatch(text)
    if plain or text[0] not in "[{(":
        names = [name.strip() for name in re.split(r"[,\n]", plain[1] if plain else text) if name.strip()]
        names = list(_without_numbers(names))
        return table_names(names) if all(map(_NAME.fullmatch, names)) else None
    for read in (ast.literal_eval, json.loads, _unquoted):
        # Not a literal; or a key that is a list, or a number that is too long to print.
        with suppress(ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            return table_names(read(text))
    return None


def _unquoted(text: str) -> dict[str, str]:
    # A table as YAML and others write it: ``{0: car, 1: bus}``. `ValueError` for anything else.
    pairs = [_PAIR.fullmatch(one) for one in text[1:-1].split(",")]
    if text[-1] != "}" or not all(pairs):
        raise ValueError(text)
    return {pair[1]: pair[3] for pair in pairs if pair}


def table_names(value: object) -> tuple[str, ...] | None:
    """Class names of a list, or of a table by number; None for anything else, and where a name is no word.

    A name is one line that a terminal can hold; one that is empty or missing is "class" and its number.
    """
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    if any(isinstance(item, dict | list | tuple | set) for item in items):
        return None
    if isinstance(value, dict):
        if set(items) == set(range(len(value))):  # by name, as Keras has them
            value = {number: name for name, number in value.items()}
        numbers = {int(key): name for key, name in value.items() if re.fullmatch(r"\d{1,6}", str(key))}
        if len(numbers) < len(value) or max(numbers, default=MAX_LABELS) >= MAX_LABELS:
            return None
        value = [numbers.get(number, "") for number in range(max(numbers, default=-1) + 1)]
    if not isinstance(value, list | tuple) or not 0 < len(value) <= MAX_LABELS:
        return None
    known = ("" if item is None else str(item)[:MAX_LABEL_CHARS] for item in value)
    plain = (shown_text(item).replace("\n", "?").strip() for item in known)
    return tuple(name or f"class {number}" for number, name in enumerate(plain))


USUAL_CONFIDENCE = 0.25
"""From where detections count, where neither the user nor the model says."""

_CONFIDENCE = "hvt.confidence"
_CALIBRATION = "hvt.calibration"
_LEAST_CONFIDENCE = 0.01


def declared_class_names(spec: str) -> tuple[str, ...] | None:
    """A detector's class names, where its file says them; None for others, motion, plug-ins and ensembles.

    Raises `UserError` where there is no such model.
    """
    if len(parts_of(spec)) > 1:
        return None
    return metadata_labels(_metadata(spec, role="detector"))


def default_confidence(spec: str) -> float:
    """From where a detector's detections start a track, 0.01…1: ``hvt.confidence`` of its metadata, else 0.25.

    ``spec`` is as of `open_detector`; of an ensemble the first counts. Raises `UserError` where there is no such
    model, or the metadata make no sense.
    """
    text = _metadata(parts_of(spec)[0], role="detector").get(_CONFIDENCE)
    if text is None:
        return USUAL_CONFIDENCE
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not _LEAST_CONFIDENCE <= value <= 1:
        raise UserError(
            f"model {spec} has {_CONFIDENCE} '{text:.80}' in its metadata; a number from {_LEAST_CONFIDENCE} to 1 is"
            " accepted"
        )
    return value


def is_calibrated(spec: str, *, role: str) -> bool:
    """Whether a model's scores were fitted to how often they are right: its metadata have ``hvt.calibration``.

    Those of the motion detector and of plug-ins are not; an ensemble's are where all its parts' are. Raises
    `UserError` where there is no such model.
    """
    parts = parts_of(spec) if role == "detector" else (spec,)
    return all(_CALIBRATION in _metadata(part, role=role) for part in parts)


def _metadata(spec: str, *, role: str) -> dict[str, str]:
    # The metadata of a file; the motion detector and plug-ins have none.
    if role == "detector" and (spec == MOTION or plug_in_of(spec) is not None):
        return {}
    words = (MOTION, *plug_in_names()) if role == "detector" else ()
    return metadata_of(resolve_model(spec, role=role, words=words))


def uncalibrated(role: str, spec: str) -> str:
    """The sentence, logged once, for a model whose scores are not calibrated."""
    plug_in = role == "detector" and plug_in_of(spec) is not None
    return (
        f"{role} {spec if plug_in else Path(spec).name} has no calibration ({_CALIBRATION} in its metadata):"
        " its scores are no probabilities"
    )
