"""The verdict of a comparison: what a user flies must be what was judged best, and no noise may choose for him."""

import shlex
from pathlib import Path

import pytest

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_common.inference.detect import detect_every
from hvt_edge.config import EdgeConfig, with_profile
from hvt_edge.config import check as check_edge
from hvt_edge.stills.policy.registry import METHODS as REGISTRY
from hvt_study.commands.compare import SIMPLEST_FIRST, command_of, verdicts
from hvt_study.matrix.compare import COMPARED, ComparePlan, CompareResult
from hvt_study.runs.methods import METHODS
from hvt_study.runs.run_settings import edge_flags
from hvt_study.runs.spec import ModelChoice, RunSpec
from hvt_study.runs.video_shape import VideoShape

MODELS = ModelChoice("aerial-nano", "aerial-nano")


def plan(clip="my clip.mp4", models=MODELS):
    return ComparePlan(clip=clip, models=models, rates_bps=(200_000,), cache=Path("cache"))


def row(method, named_f1, *, rate=200.0, half=0, **more):
    shape = {"set_fps": 3.0 if "-" in method and method[0:2] == "M0" else None}
    shape |= {
        "base_width": 960,
        "base_height": 540,
        "picture_age_p95_ms": 90.0,
        "recall": None,
        "found_share": None,
    }
    return {"method": method, "rate_kbps": rate, "half": half, "named_f1": named_f1, **shape, **more}


def result(*rows):
    every = tuple({**one, "half": half} for one in rows for half in (0, 1, 2))
    return CompareResult(every, (), "exact", "clip")


FEWER = ", .110 more than the next, M0-fps."


@pytest.mark.parametrize(
    ("rows", "begins", "ends"),
    [
        # Who reads the last line alone must know what to fly, and why.
        ([row("M0", 0.6), row("M0-fps", 0.7), row("M6", 0.81)], f"fly M6: named F1 .810{FEWER}", FEWER),
        # Within noise the simplest wins: the next flight turns the difference round.
        (
            [row("M0", 0.70), row("tracks", 0.705), row("M6", 0.709)],
            "fly M0: named F1 .700. tracks, M6 within .01",
            "",
        ),
        ([row("M0", 0.699), row("tracks", 0.705), row("M6", 0.709)], "fly tracks: ", ""),
        # Three frames a second may show most, and still be too late for who steers by them.
        (
            [row("M0-best", 0.8, picture_age_p95_ms=612.0), row("M0", 0.5)],
            "fly M0-best at 960x540 and 3 frames a second",
            " Its newest picture is up to 0.6 s old.",
        ),
        # Of one target recall decides: nobody knows what else is in view.
        (
            [row("M0", None, recall=0.2), row("M6", None, recall=0.5)],
            "fly M6: recall .500",
            "",
        ),
        # A command would be printed that shows nothing.
        ([row("M0", 0.0), row("M6", 0.0)], "no method shows anything right", " (named F1 .000)."),
        # A 0 would be said of what nobody knows.
        ([row("M0", None), row("M6", None)], "nothing can be judged", "no object of the clip counts."),
    ],
)
def test_the_best_one_is_named_with_its_lead(rows, begins, ends):
    """Who reads the last line alone must know what to fly, and why."""
    (one,) = verdicts(plan(), result(*rows))
    assert one.sentence.startswith(f"At 200 kbps {begins}")
    assert one.sentence.endswith(ends)
    assert bool(one.command) == begins.startswith("fly")
    if ends == FEWER:
        assert one.command == "hvt-edge --source 'my clip.mp4' --budget 200kbps --size 960x540 --profile thin"


@pytest.mark.parametrize("found_share", [0.0, None])
def test_one_target_that_nobody_finds_is_a_target(found_share):
    """A clip that was lost at every rate would be called one without labels."""
    assert result(row("M0", None, found_share=found_share)).one_target is (found_share is not None)


def test_each_rate_has_a_verdict():
    """The best method depends on the rate."""
    rows = [row("M0", 0.2), row("M6", 0.6), row("M0", 0.9, rate=800.0), row("M6", 0.9, rate=800.0)]
    assert [("M0:" in one.sentence) for one in verdicts(plan(), result(*rows))] == [False, True]


def config_of(flags):
    config, given = load(EdgeConfig, flags, program="hvt-edge", description="")
    return check_edge(with_profile(config, given=given.values))


@pytest.mark.parametrize("name", COMPARED)
def test_the_command_flies_what_was_compared(name):
    """What is flown would be something else than what was judged."""
    method, codec = COMPARED[name]
    assert set(SIMPLEST_FIRST) == set(COMPARED), "a method that is compared could never be advised"
    chosen = bool(METHODS[method].fps_choices)
    one = row(name, 0.5, set_fps=1.0 if chosen else None)
    command = shlex.split(command_of(plan(), one))
    assert command[0] == "hvt-edge"
    theirs = config_of(command[1:])
    spec = RunSpec("clips:x", "x", method, "200kbps", 200_000, MODELS, codec, size=(960, 540))
    shape = VideoShape(1.0, (960, 540)) if chosen else VideoShape()
    ours = config_of(["--source", "my clip.mp4", *edge_flags(spec, budget_bps=200_000, shape=shape)])
    own = {"pace", "threads", "profile", "confidence", "detect_every"}
    own |= {"provider", "preset"}  # a study has to repeat, a flight to be quick
    if method.startswith("M0"):
        own |= {"camera_motion"}
    else:
        assert detect_every(theirs.detect_every, fps=theirs.nominal_fps) == ours.detect_every
    for field in EdgeConfig.__dataclass_fields__.keys() - own:
        if field == "still_codec" and not codec:
            continue
        assert getattr(theirs, field) == getattr(ours, field), field


@pytest.mark.parametrize("name", [name for name in COMPARED if name not in ("M0", "R0")])
def test_names_of_the_table_are_profiles(name):
    """Who types what the table says would be left with an error that does not help."""
    assert config_of(["--source", "x.mp4", "--budget", "300kbps", "--profile", name]).budget_bps == 300_000
    if name not in REGISTRY:
        with pytest.raises(UserError, match=f"or give --profile {name}"):
            load(EdgeConfig, ["--method", name], program="hvt-edge", description="")
