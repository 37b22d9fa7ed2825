"""Where the files of a run lie for a process that was started in another folder."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from hvt_study.runs.spec import RunSpec

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
    """What has a folder or a suffix in it is a path, as for `hvt_common.inference.store.resolve_model`."""
    separators = (os.sep, os.altsep or os.sep)
    is_path = "." in spec or any(one in spec for one in separators)
    return str(folder / spec) if is_path and not spec.startswith("~") else spec
