"""One run of the matrix: everything that decides its result, where its files lie for a process, and its row."""

import csv
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

MATCH_TOLERANCE = 0.01
"""A run that is to match another's total may miss it by so much, and is marked failed beyond."""

LabelKind = Literal["annotations", "reference"]


@dataclass(frozen=True, slots=True)
class ModelChoice:
    """The networks of a run: values of ``--detector`` and ``--classifier``."""

    detector: str
    """The ground's, and that of reference labels."""
    edge_detector: str
    classifier: str = "detector"
    """``detector`` (it looks at the still again), ``none``, or a classifier."""
    refine: str = "fuse"
    provider: str = "cpu"


@dataclass(frozen=True, slots=True)
class Target:
    """The run whose total this one has to spend, within `MATCH_TOLERANCE`."""

    method: str
    still_codec: str
    total_bps: int
    """The bits that run really spent over the processed span."""


@dataclass(frozen=True, slots=True)
class RunSpec:
    """One flight of one method. Two equal ones have the same result to the bit."""

    dataset: str
    """URI, such as ``visdrone:/data/VisDrone2019-VID-val``."""
    sequence: str
    method: str
    """A name of `hvt_study.runs.methods.METHODS`."""
    regime: str
    """``low``, ``moderate``, or the budget in words, such as ``300kbps``."""
    budget_bps: int
    models: ModelChoice
    still_codec: str = "jpeg"
    labels: LabelKind = "reference"
    size: tuple[int, int] = (1280, 720)
    """(width, height) of the base stream in pixels."""
    max_frames: int | None = None
    detect_every: int = 5
    """Frames from one detection to the next, at the edge and at the ground. The peer looks at all that it codes."""
    target: Target | None = None
    """For video-only methods: spend the same as this run; None: the budget itself."""
    tune: tuple[str, ...] = field(default=())
    """``KEY=VALUE`` of the method's parameters other than their defaults."""

    @property
    def key(self) -> str:
        """Names the spec: hexadecimal, the same on every machine. Contents of clips and models are not in it."""
        text = json.dumps(asdict(self), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:32]


def said_run(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """The spec of a row of ``results.parquet``, out of its ``config``; empty where it is no row of ours."""
    run = table_of(row["config"]).get("run")
    return run if isinstance(run, Mapping) else {}


def table_of(text: str | None) -> Mapping[str, Any]:
    """A table in JSON, as columns of a row hold it; empty for anything else."""
    try:
        found = json.loads(text or "{}")
    except (ValueError, RecursionError, TypeError):
        return {}
    return found if isinstance(found, Mapping) else {}


_WITHOUT_PATH = frozenset({"demo"})


def located(spec: RunSpec, *, folder: Path) -> RunSpec:
    """The run with the paths of its dataset and models made absolute, as they are seen from ``folder``.

    It is for opening them only: a run is named, remembered and reported in the words in which it was asked for, so
    that machines which keep their files at different places speak of the same runs.
    """
    models = spec.models
    return replace(
        spec,
        dataset=_dataset(spec.dataset, folder),
        models=replace(
            models,
            detector=_model(models.detector, folder),
            edge_detector=_model(models.edge_detector, folder),
            classifier=_model(models.classifier, folder),
        ),
    )


def _dataset(uri: str, folder: Path) -> str:
    scheme, colon, place = uri.partition(":")
    if not colon or not place or place.startswith("~") or scheme in _WITHOUT_PATH:
        return uri
    return f"{scheme}:{folder / place}"


def _model(spec: str, folder: Path) -> str:
    """A word with a folder or a suffix is a path, as for `hvt_common.inference.store.resolve_model`."""
    separators = (os.sep, os.altsep or os.sep)
    is_path = "." in spec or any(one in spec for one in separators)
    return str(folder / spec) if is_path and not spec.startswith("~") else spec


Type = Literal["text", "int", "real", "yes"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column, its type, its meaning, and how the tables of the report show it."""

    name: str
    type: Type
    group: str
    """Group of metrics; empty for columns that no table of the report shows."""
    title: str
    style: Literal["", "share", "kbps", "count", "seconds", "ms", "bytes", "rate", "nats"]
    better: Literal["", "more", "less"]
    over: Literal["", "mean", "median"]
    """The average over sequences: waits may be infinite, which a mean does not survive."""
    description: str
    """``{time}`` stands for the time that rates are divided by."""


def _columns() -> tuple[Column, ...]:
    text = files("hvt_study.runs").joinpath("columns.csv").read_text(encoding="utf-8")
    rows: list[dict[str, Any]] = list(csv.DictReader(text.splitlines()))
    return tuple(Column(**row) for row in rows)


COLUMNS: tuple[Column, ...] = _columns()
