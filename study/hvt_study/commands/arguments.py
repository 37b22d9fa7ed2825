"""The arguments that ``run``, ``plan`` and ``tune`` share, and the plan that they make."""

import argparse
import math
import os
from collections.abc import Mapping
from collections.abc import Sequence as Many
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from hvt_common.errors import UserError
from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import open_detector
from hvt_common.inference.labels import first_synonym
from hvt_common.inference.runtimes.model import provider_here
from hvt_common.inference.runtimes.plug_in import plug_in_of
from hvt_common.inference.runtimes.providers import PROVIDERS
from hvt_common.inference.store import EMBEDDED_DETECTOR, MOTION, parts_of
from hvt_common.units import parse_size
from hvt_common.video.still_codecs import still_codec
from hvt_edge.source.contract import check_shape
from hvt_ground.config import DETECTOR, NONE
from hvt_study.cache.results import check_cache
from hvt_study.datasets.class_map import joint_classes
from hvt_study.datasets.layouts.uri import DATASETS, open_datasets
from hvt_study.datasets.sequence import Sequence
from hvt_study.matrix.plan import StudyPlan, parse_regimes
from hvt_study.matrix.pools import dask_pool, local_pool
from hvt_study.matrix.tuning import tuned_methods
from hvt_study.metrics.bits import ACCOUNTINGS
from hvt_study.runs.methods import METHODS, Kind, chosen_methods, chosen_names
from hvt_study.runs.spec import ModelChoice

_LEAST_FRAMES = 30
_LEAST_KBPS, _MOST_KBPS = 20.0, 100_000.0
_MOST_JOBS = 256
_ALL_AT_ONCE = 10_000
"""A cluster has a queue of its own."""


_USUAL: Mapping[str, dict[str, Any]] = {
    "--accounting": {
        "choices": ACCOUNTINGS,
        "help": "rates by the processed span, or by the length of the whole clip as in the pilot's notebooks, for "
        "comparison with its tables",
    },
    "--cache": {"type": Path, "metavar": "DIR", "help": "finished flights (default: DIR/cache)"},
    "--classes": {
        "default": None,
        "metavar": "NAME,…",
        "help": "class names of YOLO labels without classes.txt",
    },
    "--classifier": {
        "action": "append",
        "help": "reads the stills: detector, none, FILE.onnx or a model's name; may be given several times "
        "(default: detector)",
    },
    "--dask": {
        "metavar": "tcp://…",
        "help": "run on the workers of this Dask cluster instead, which see the same files "
        "(dask worker --nthreads 1)",
    },
    "--detect-every": {
        "type": int,
        "default": 5,
        "metavar": "N",
        "help": "detect on every n-th frame, at edge and ground; DDS detects on every frame that it codes",
    },
    "--detector": {"metavar": "FILE"},
    "--edge-detector": {"metavar": "FILE", "help": "detector of the edge (default: the ground's)"},
    "--jobs": {
        "type": int,
        "metavar": "N",
        "help": "processes at a time, each with one thread and the pictures of one sequence (default: the cores)",
    },
    "--labelled": {
        "default": None,
        "metavar": "KIND,…",
        "help": "kinds that are labelled, such as vehicle; others are not judged (default: all that are named)",
    },
    "--labels": {
        "default": "annotations",
        "choices": ("annotations", "reference"),
        "help": "what counts as true: the dataset's annotations, or the ground's detector on the untouched frames",
    },
    "--limit": {"type": int, "metavar": "N", "help": "at most so many sequences of each dataset"},
    "--matched-to": {
        "metavar": "NAME,…",
        "help": "methods at whose totals video is coded again (default: each of --methods that is not video)",
    },
    "--max-frames": {"type": int, "metavar": "N", "help": "at most so many frames of the clip, 15 a second"},
    "--methods": {"metavar": "NAME,…", "help": "methods to fly"},
    "--only": {
        "action": "append",
        "default": [],
        "metavar": "NAME",
        "help": "only sequences of this name or pattern; may be given several times",
    },
    "--out": {"type": Path, "required": True, "metavar": "DIR"},
    "--provider": {
        "default": "cpu",
        "help": "runtime of the networks, as for hvt-edge; auto may choose another each time",
    },
    "--rates": {"metavar": "KBPS,…", "help": "budgets in kbps"},
    "--refine": {
        "default": "fuse",
        "choices": ("replace", "fuse"),
        "help": "how stills change a class, as for hvt-ground",
    },
    "--regimes": {
        "default": "low,moderate",
        "metavar": "NAME,…",
        "help": "budgets: low (800kbps), moderate (1400kbps), or such as 300kbps",
    },
    "--size": {"default": "1280x720", "metavar": "WxH", "help": "size of the base stream"},
    "--still-codecs": {"default": "jpeg", "metavar": "NAME,…", "help": "codecs of the methods with stills"},
    "--tune": {
        "action": "append",
        "default": [],
        "metavar": "METHOD:KEY=VALUE,…|FILE",
        "help": "parameters of a method other than its defaults, or the tune.json of a search",
    },
}


def option(parser: argparse.ArgumentParser, name: str, **own: Any) -> None:
    """Add an option, of several commands or with all that is this command's ``own``; no default is not shown."""
    parser.add_argument(name, **{"default": argparse.SUPPRESS, **_USUAL.get(name, {}), **own})


def add_pool_arguments(parser: argparse.ArgumentParser) -> None:
    option(parser, "--jobs")
    option(parser, "--dask")


def add_plan_arguments(parser: argparse.ArgumentParser, *, methods: bool = True, writes: bool = True) -> None:
    """All that decides which runs there are; ``methods`` where several may be named, ``writes`` with ``--out``."""
    parser.add_argument("datasets", nargs="+", metavar="DATASET", help=", ".join(DATASETS))
    several = (
        "detector of the ground, and of reference labels: FILE.onnx or a model's name; may be given several times "
        "(default: the embedded one)"
    )
    option(parser, "--detector", action="append", help=several)
    for name in ("--edge-detector", "--classifier", "--refine"):
        option(parser, name)
    every = ",".join(METHODS)
    if methods:
        option(parser, "--methods", default=every)
        option(parser, "--matched-to")
        option(parser, "--tune")
    else:
        parser.set_defaults(methods=every, tune=[])
    for name in ("--regimes", "--still-codecs", "--labels", "--detect-every", "--size"):
        option(parser, name)
    option(parser, "--max-frames", help="at most so many frames of each sequence, 15 a second")
    for name in ("--limit", "--only", "--provider"):
        option(parser, name)
    written = "results.parquet, report.html, …" if writes else "not needed: nothing is written"
    option(parser, "--out", required=writes, help=written)
    option(parser, "--cache")
    parser.set_defaults(writes=writes)


def parse_rates(text: str) -> tuple[int, ...]:
    """``150,300`` kbps as bits a second, rising, each once; `UserError` for text that is no such rate."""
    rates: set[int] = set()
    for word in text.split(","):
        try:
            kbps = float(word)
        except ValueError:
            kbps = math.nan
        if not _LEAST_KBPS <= kbps <= _MOST_KBPS:
            raise UserError(
                f"--rates {word.strip()!r} is not accepted: give kbps from {_LEAST_KBPS:g} to {_MOST_KBPS:g}, "
                "for example 150,300"
            )
        rates.add(round(kbps * 1000))
    return tuple(sorted(rates))


def check_whole(name: str, value: int, low: int, high: int | None = None) -> int:
    """The value of an option; `UserError` where it is not in its range."""
    if not low <= value <= (value if high is None else high):
        most = "" if high is None else f" to {high}"
        raise UserError(f"{name} {value} is not accepted: give a whole number from {low}{most}")
    return value


def names_of(text: str | None) -> tuple[str, ...]:
    return tuple(word.strip() for word in (text or "").split(",") if word.strip())


def base_size(text: str) -> tuple[int, int]:
    """``--size`` of a base stream, (width, height); `UserError` for one that cannot be flown."""
    size = parse_size(text, name="--size")
    check_shape(size=size, fps=15)
    return size


def flown_frames(frames: int | None) -> int | None:
    """``--max-frames``; `UserError` for so few that there is nothing to measure."""
    if frames is not None and frames < _LEAST_FRAMES:
        raise UserError(f"--max-frames {frames} is too few: give {_LEAST_FRAMES} or more")
    return frames


def check_means(arguments: argparse.Namespace) -> None:
    """`UserError` at once for a provider that is not here (with Dask: not known), or a cache that takes no files."""
    if not hasattr(arguments, "dask") or arguments.provider not in PROVIDERS:
        provider_here(arguments.provider)
    if hasattr(arguments, "cache") and arguments.writes:
        check_cache(arguments.cache)


def open_sequences(arguments: argparse.Namespace) -> tuple[tuple[str, Sequence], ...]:
    """(URI, sequence) of all that the arguments name; `UserError` where labels are asked for that nobody made."""
    check_means(arguments)
    limit = getattr(arguments, "limit", None)
    found = tuple(open_datasets(arguments.datasets, limit=limit, only=arguments.only))
    for uri, one in found:
        if one.labels is None and arguments.labels == "annotations":
            raise UserError(f"{uri} {one.name} has no annotations: add --labels reference, or leave it out")
    return found


def study_plan(arguments: argparse.Namespace, sequences: Many[tuple[str, Sequence]]) -> StudyPlan:
    """The plan of the arguments, with the sequences of `open_sequences`; `UserError` for an impossible one."""
    size = base_size(arguments.size)
    frames = flown_frames(getattr(arguments, "max_frames", None))
    cache: Path = getattr(arguments, "out", Path()) / "cache"  # who plans writes nothing
    check_whole("--detect-every", arguments.detect_every, 1)
    codecs = tuple(dict.fromkeys(names_of(arguments.still_codecs) or ("",)))
    for codec in codecs:
        still_codec(codec)
    plan = StudyPlan(
        sequences=tuple((uri, one.name) for uri, one in sequences),
        methods=chosen_methods(arguments.methods),
        regimes=parse_regimes(arguments.regimes),
        still_codecs=codecs,
        models=_models(arguments),
        labels=arguments.labels,
        cache=Path(getattr(arguments, "cache", cache)).absolute(),
        size=size,
        max_frames=frames,
        detect_every=arguments.detect_every,
        tune=_tune(arguments),
        matched_to=_matched_to(arguments),
    )
    _check_classes(plan, sequences)
    return plan


def _matched_to(arguments: argparse.Namespace) -> tuple[str, ...] | None:
    if not hasattr(arguments, "matched_to"):
        return None
    known = [one.name for one in chosen_methods(arguments.methods) if one.kind is not Kind.VIDEO]
    return chosen_names(arguments.matched_to, known, flag="--matched-to")


def open_pool(arguments: argparse.Namespace) -> tuple[AbstractContextManager[Any], int]:
    """The pool that the arguments ask for, and how many runs to hand it at once."""
    if hasattr(arguments, "dask") and not hasattr(arguments, "jobs"):
        return dask_pool(arguments.dask), _ALL_AT_ONCE
    jobs = jobs_of(arguments)
    return local_pool(jobs), jobs


def jobs_of(arguments: argparse.Namespace) -> int:
    """How many processes on this machine; `UserError` for a number that cannot be, or has no effect."""
    jobs: int = getattr(arguments, "jobs", os.cpu_count() or 1)
    if hasattr(arguments, "dask"):
        raise UserError(f"--jobs {jobs} has no effect with --dask: give one of them")
    return check_whole("--jobs", jobs, 1, _MOST_JOBS)


def _models(arguments: argparse.Namespace) -> tuple[ModelChoice, ...]:
    detectors: list[str] = getattr(arguments, "detector", [EMBEDDED_DETECTOR])
    models = tuple(
        ModelChoice(
            detector=detector,
            edge_detector=getattr(arguments, "edge_detector", detector),
            classifier=classifier,
            refine=arguments.refine,
            provider=arguments.provider,
        )
        for detector in dict.fromkeys(detectors)
        for classifier in dict.fromkeys(getattr(arguments, "classifier", ["detector"]))
    )
    if any(MOTION in (one.detector, one.edge_detector) for one in models):
        raise UserError(f"{MOTION!r} remembers pictures, and cannot serve a study: give a detection network")
    for one in models:
        for name in (one.detector, one.edge_detector):
            if len(parts_of(name)) > 1:
                raise UserError(f"detector {name!r} is several: a study takes one ONNX model")
            if plug_in_of(name) is not None:
                raise UserError(
                    f"detector {name!r} is a plug-in, and no file names its results: give an ONNX model"
                )
    return models


def _tune(arguments: argparse.Namespace) -> dict[str, tuple[str, ...]]:
    found = tuned_methods(arguments.tune)
    flown = {one.name for one in chosen_methods(arguments.methods)}
    for name in found:
        if name not in flown:
            raise UserError(f"--tune of {name} has no effect: it is not among --methods {arguments.methods}")
    return found


def _check_classes(plan: StudyPlan, sequences: Many[tuple[str, Sequence]]) -> None:
    """Before anything is flown, for the last sequence as for the first."""
    for model, reader in dict.fromkeys((one.detector, one.classifier) for one in plan.models):
        names = open_detector(model, threads=1).class_names
        read = None if reader in (DETECTOR, NONE) else open_classifier(reader, threads=1).class_names
        own = (tuple(map(first_synonym, read or names)),)
        sets = own if plan.labels == "reference" else (one.class_set for _, one in sequences)
        for class_set in dict.fromkeys(sets):
            joint_classes(names, read, class_set)
