"""What does the ground show at this budget on my clip? The methods at some rates over one clip, flown and scored.

The runs are those of `hvt-study run`, without the matching of totals: same methods, same cache, same scores. *Labels*
are exact where the source knows its objects (the demo, an annotated picture under the virtual camera), else
*reference* labels (`hvt_study.datasets.reference`).
"""

from collections.abc import Callable, Mapping
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

from hvt_common.errors import UserError, telling
from hvt_edge.wiring import default_size
from hvt_study.datasets.label_files import in_any_case
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.datasets.sequence import Sequence
from hvt_study.datasets.virtual_camera import SCHEME, open_camera
from hvt_study.runs.methods import METHODS
from hvt_study.runs.spec import ModelChoice, RunSpec

COMPARED: Mapping[str, tuple[str, str]] = {
    "M0": ("M0", ""),
    "M0-fps": ("M0-fps", ""),
    "M0-best": ("M0-best", ""),
    "R0": ("R0", ""),
    "M5-jpeg": ("M5", "jpeg"),
    "M5-residual": ("M5", "residual"),
    "tracks": ("tracks", ""),
    "M6": ("M6", "residual"),
    "auto": ("auto", ""),
}
"""(method, still codec) by the name in tables, in their order."""
Labels = Literal["auto", "exact", "reference"]


@dataclass(frozen=True, slots=True)
class ComparePlan:
    """The plan of a comparison."""

    clip: str
    """A video, a folder of images, ``demo``, or ``still:PICTURE``."""
    models: ModelChoice
    rates_bps: tuple[int, ...]
    cache: Path
    methods: tuple[str, ...] = tuple(COMPARED)
    size: tuple[int, int] | None = None
    """(width, height) of the base stream in pixels; None: as of ``hvt-edge``, never larger than the source."""
    max_frames: int | None = None
    labels: Labels = "auto"
    classes: tuple[str, ...] = ()
    """Names of the classes of a picture's YOLO labels; none: those of ``classes.txt``."""
    labelled: tuple[str, ...] = ()
    """Kinds that the clip's labels know: objects of others count neither way. None: all that they name."""


_Run: TypeAlias = tuple[int, str]
CompareRow: TypeAlias = dict[str, Any]
"""One flight over the whole clip (``half`` 0) or one half of it (1, 2), by the names of `_FIGURES`; docs/compare.md
defines them. Figures that are not of the list are of the whole clip, in all three alike."""

_FIGURES = (
    *(("named_f1", "named_f1{half}", 4), ("false_per_frame", "false_per_frame{half}", 3)),
    *(("f1", "f1{half}", 4), ("class_agreement", "top1{half}", 4)),
    *((name, name, 0) for name in ("total_bps", "base_bps", "roi_bps", "track_bps", "max_frame_bytes")),
    *(
        ("delay_p95_ms", "delay_p95_ms", 1),
        ("edge_cpu_ms", "edge_cpu_ms", 1),
        ("labels", "", 0),
        ("fps", "fps", 2),
        ("set_fps", "set_fps", 2),
        ("base_width", "base_width", 0),
        ("base_height", "base_height", 0),
    ),
    *(("precision", "precision{half}", 4), ("recall", "recall{half}", 4)),
    *((name, name, 1) for name in ("delay_p50_ms", "picture_age_p95_ms")),
    *((name, name, 0) for name in ("worst_queue_bytes", "stills")),
    *((name, name, 3) for name in ("found_share", "gaps", "longest_gap_s", "id_switches")),
)
"""Name in compare.json, column of the study's table, digits."""


@dataclass(frozen=True, slots=True)
class Missing:
    """A method that could not be flown at a rate."""

    rate_kbps: float
    method: str
    reason: str


@dataclass(frozen=True, slots=True)
class CompareResult:
    """All rows, by rate, then in the table's order of methods, then by half: 0, 1, 2."""

    rows: tuple[CompareRow, ...]
    missing: tuple[Missing, ...]
    labels: str
    clip: str

    @property
    def one_target(self) -> bool:
        """Whether one object is labelled and nothing else: recall can be said of it, and how steadily it is held."""
        return all(row["named_f1"] is None for row in self.rows) and any(
            row["found_share"] is not None for row in self.rows
        )

    @property
    def flights(self) -> tuple[tuple[CompareRow, CompareRow, CompareRow], ...]:
        """The whole clip, its first and its second half, of each flight."""
        return tuple(zip(self.rows[::3], self.rows[1::3], self.rows[2::3], strict=True))


def compare(
    plan: ComparePlan,
    *,
    pool: Executor,
    on_run: Callable[[int, int, bool], None] = lambda *_: None,
) -> CompareResult:
    """Fly everything; ``on_run(done, of, alike)`` is called at once and after each method at each rate.

    ``alike`` is False after one of more flights than those at the end.
    Raises `UserError` where the clip, a detector or a rate cannot be used.
    """
    uri, sequence = opened(plan)
    if plan.labels == "exact" and sequence.labels is None:
        raise UserError(f"--labels exact: {plan.clip} does not say what it shows; leave --labels out")
    labels = "reference" if sequence.labels is None or plan.labels == "reference" else "exact"
    specs = {
        (rate_bps, name): RunSpec(
            dataset=uri,
            sequence=sequence.name,
            method=COMPARED[name][0],
            regime=f"{rate_bps / 1e3:g}kbps",
            budget_bps=rate_bps,
            models=plan.models,
            still_codec=COMPARED[name][1],
            labels="reference" if labels == "reference" else "annotations",
            size=plan.size or default_size(sequence.source_size, fit="letterbox"),
            max_frames=plan.max_frames,
        )
        for rate_bps in plan.rates_bps
        for name in plan.methods
    }
    run = partial(_run, cache=plan.cache, folder=Path.cwd())
    # Those of most flights first, so that no process is left with one at the end.
    order = sorted(specs, key=lambda one: _shapes(specs[one]), reverse=True)
    running = {pool.submit(run, specs[one]): one for one in order}
    done: dict[_Run, dict[str, Any]] = {}
    on_run(0, len(specs), True)
    try:
        for future in as_completed(running):
            one = running[future]
            done[one] = future.result()
            on_run(len(done), len(specs), _shapes(specs[one]) == _shapes(specs[order[-1]]))
    finally:
        for future in running:
            future.cancel()
    return _result(sequence.name, labels, [(one, done[one]) for one in specs])


def _run(spec: RunSpec, *, cache: Path, folder: Path) -> dict[str, Any]:
    """`run_spec`, loaded where it is done: here it would keep the first line waiting for seconds."""
    from hvt_study.runs.execute import run_spec  # noqa: PLC0415

    return run_spec(spec, cache=cache, folder=folder)


def _shapes(spec: RunSpec) -> tuple[bool, int]:
    """How much is tried for the best of it."""
    method = METHODS[spec.method]
    return method.any_size, len(method.fps_choices)


def opened(plan: ComparePlan) -> tuple[str, Sequence]:
    """The clip as a dataset of one sequence; `UserError` where it cannot be used."""
    clip = plan.clip
    with telling(f"clip {clip!r} cannot be read (", "): name another"):
        uri, options = _located(clip)
    options |= _label_options(plan, uri)
    if options:
        uri += "?" + "&".join(f"{name}={value}" for name, value in options.items())
    found = open_dataset(uri, limit=2)
    if len(found) > 1:
        raise UserError(f"clip {clip} holds several videos: give one of them")
    return uri, found[0]


def _located(clip: str) -> tuple[str, dict[str, str]]:
    """The clip's dataset, and the options of a picture's camera."""
    options: dict[str, str] = {}
    if clip == "demo":
        uri = "demo:0"
    elif clip.startswith(SCHEME):
        camera = open_camera(clip, fps=1)  # names faults of picture and height
        uri = f"{SCHEME}{camera.picture_path}"
        options["view"] = f"{camera.view_heights:g}"
    elif Path(clip).is_dir() and in_any_case(Path(clip) / "gt" / "gt.txt").is_file():
        uri = f"mot:{clip}"
    elif Path(clip).exists():
        uri = f"clips:{clip}"
    else:
        raise UserError(
            f"clip {clip!r} does not exist: give a video, a folder of images, a MOTChallenge sequence, demo or "
            f"{SCHEME}PICTURE"
        )
    return uri, options


def _label_options(plan: ComparePlan, uri: str) -> dict[str, str]:
    """The options to read the clip's own labels with."""
    scheme = uri.partition(":")[0]
    own = scheme in ("still", "mot")
    if own and plan.labels == "reference":
        return {"labels": "none"}
    given = {"classes": ",".join(plan.classes), "labelled": ",".join(plan.labelled)}
    for name, value in given.items():
        if value and not (own and (name == "labelled" or scheme == "still")):
            kind = (
                "a picture with YOLO labels" if name == "classes" else "a picture or a sequence with labels"
            )
            raise UserError(f"--{name} {value} has no effect on {plan.clip}: it is for {kind}")
    return {name: value for name, value in given.items() if value}


def _result(clip: str, labels: str, done: list[tuple[_Run, dict[str, Any]]]) -> CompareResult:
    rows: list[CompareRow] = []
    missing: list[Missing] = []
    flown: dict[tuple[int, str], str] = {}
    for (rate_bps, name), row in done:
        chosen = bool(METHODS[COMPARED[name][0]].fps_choices)  # the best of several may be a plain one
        same = None if chosen else flown.get((rate_bps, row["digest"]))
        if row["failed"]:
            missing.append(Missing(rate_bps / 1e3, name, row["failed"]))
        elif same is not None:
            missing.append(Missing(rate_bps / 1e3, name, f"its settings change nothing over {same}"))
        else:
            flown.setdefault((rate_bps, row["digest"]), name)
            rows += [
                _half(row, half, labels=labels, clip=clip, rate_kbps=rate_bps / 1e3, method=name)
                for half in (0, 1, 2)
            ]
    return CompareResult(tuple(rows), tuple(missing), labels, clip)


def _half(row: Mapping[str, Any], half: int, *, labels: str, **place: Any) -> CompareRow:
    found: CompareRow = {**place, "half": half}
    suffix = f"_half_{half}" if half else ""
    for name, column, digits in _FIGURES:
        value = row[column.format(half=suffix)] if column else labels
        found[name] = round(value, digits) if isinstance(value, float) else value
    return found
