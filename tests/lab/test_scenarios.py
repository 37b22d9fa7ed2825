"""The short scenarios, with hvt-edge and hvt-ground as real processes: cheap settings, so no bar of speed is asked.

`make link` measures; here it is only asked that both survive, keep their account, and show a picture again.
"""

from __future__ import annotations

import concurrent.futures
import os
from pathlib import Path

import psutil
import pytest

from lab.link.carriers.netns import UnavailableError
from lab.link.laboratory import Run, run
from lab.link.measures.outcome import Outcome, measures
from lab.link.script import load_scenario, scenario_names
from media.pictures import write_scene

pytestmark = [pytest.mark.integration, pytest.mark.realtime, pytest.mark.timeout(900)]

EDGE = (
    *("--source-fps", "10", "--fps", "10", "--size", "320x180", "--preset", "ultrafast"),
    *("--detector", "motion"),
)
GROUND = ("--detector", "motion", "--classifier", "none")
AT_ONCE = min(5, os.cpu_count() or 1)
"""Flights in real time: so many as the machine has time for."""
PICTURE_WITHIN_S = 3.0
SOAK_S = 60
NAMES = scenario_names()


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Pictures for longer than any short script lasts."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, frames=10 * SOAK_S + 150)
    return folder


def short(name: str, scene: Path, folder: Path, **more: str) -> Outcome:
    """One short run at little cost."""
    return run(
        Run(
            scenario=load_scenario(name),
            source=str(scene),
            folder=folder / name,
            length="short",
            edge_arguments=EDGE,
            ground_arguments=GROUND,
            **more,
        )
    )


@pytest.fixture(scope="module")
def outcomes(scene, tmp_path_factory) -> dict[str, Outcome | str]:
    """The scenarios over the relay, a few at a time."""
    folder = tmp_path_factory.mktemp("link")
    with concurrent.futures.ThreadPoolExecutor(AT_ONCE) as pool:
        soak = pool.submit(short, "drone-fade", scene, folder / "soak", lasts=f"{SOAK_S}s")
        names = sorted(scenario_names(), key=lambda name: -load_scenario(name).script("short").lasts_s)
        running = {name: pool.submit(short, name, scene, folder) for name in names}
        # The relay's TCP is a model; where there are namespaces, the kernel's own is asked too.
        running["kernel"] = pool.submit(short, "steady-300k", scene, folder / "kernel", carrier="netns")
        return {name: _result(one) for name, one in (running | {"soak": soak}).items()}


def _result(running: concurrent.futures.Future[Outcome]) -> Outcome | str:
    try:
        return running.result()
    except UnavailableError as error:
        return str(error)


@pytest.mark.parametrize("name", NAMES)
def test_both_sides_survive(outcomes, name):
    """A bad link would end the flight's video for good."""
    outcome = outcomes[name]
    assert outcome.exit_codes == {"edge": 0, "ground": 0}, outcome.said
    assert not [text for text in outcome.said.values() if "Traceback" in text]


@pytest.mark.parametrize("name", NAMES)
def test_there_is_a_picture_at_the_end(outcomes, name):
    """After a fade the operator would look at the last frame before it."""
    outcome = outcomes[name]
    assert outcome.edge["frames"] > 0
    last = max(one.received_s for one in outcome.shown)
    light_s = max((end_s for _, end_s in outcome.script.dark), default=0.0)
    assert last > max(outcome.ended_s - PICTURE_WITHIN_S, outcome.began_s + light_s), outcome.said
    assert measures(outcome)["decodable frames, %"] > 0


@pytest.mark.parametrize("name", ["steady-1M", "steady-300k", "satellite-600ms"])
def test_a_steady_link_loses_nothing(outcomes, name):
    """The two accounts would differ, and with them what the budget means."""
    found = measures(outcomes[name])
    assert found["ledger difference, bytes"] == 0
    assert found["stills lost"] == 0
    assert found["decodable frames, %"] == 100


@pytest.mark.parametrize("name", ["outage-8s", "outage-60s", "flapping", "drone-fade"])
def test_darkness_is_dark(outcomes, name):
    """The lab would be testing nothing."""
    assert measures(outcomes[name])["received in darkness, bytes"] == 0


@pytest.mark.parametrize("side", ["edge", "ground"])
def test_a_minute_of_fading_costs_neither_descriptors_nor_threads(outcomes, side):
    """An hour of it would cost sixty times as many (`make soak` flies that hour)."""
    found = measures(outcomes["soak"])
    assert found[f"{side}, descriptors more at the end"] <= 0
    assert found[f"{side}, threads more at the end"] <= 0


def test_a_minute_of_fading_keeps_its_account(outcomes):
    """What a bad link costs would be told wrongly by one of the two."""
    outcome = outcomes["soak"]
    assert outcome.exit_codes == {"edge": 0, "ground": 0}, outcome.said
    found = measures(outcome)
    assert found["ledger difference, bytes"] == 0
    assert found["stills lost"] == 0
    assert found["base messages lost"] == 0


def test_a_satellite_is_far_away(outcomes):
    """As above."""
    assert measures(outcomes["satellite-600ms"])["frame delay p50, ms"] >= 300


def test_no_process_is_left(outcomes):
    """A night of runs would fill the machine."""
    assert outcomes
    assert not psutil.Process().children(recursive=True)


def test_the_same_on_the_kernels_own_tcp(outcomes):
    """The model would be kind where the real thing is not."""
    outcome = outcomes["kernel"]
    if isinstance(outcome, str):
        pytest.skip(outcome)
    assert outcome.exit_codes == {"edge": 0, "ground": 0}, outcome.said
    assert measures(outcome)["ledger difference, bytes"] == 0
    assert measures(outcome)["decodable frames, %"] == 100
