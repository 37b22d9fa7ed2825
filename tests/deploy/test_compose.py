"""deploy/compose.yaml: read, checked against the real parsers, and its commands run as processes without Docker."""

import importlib
import importlib.util
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

from hvt_common.config import load
from hvt_edge.config import EdgeConfig
from hvt_edge.config import check as check_edge
from hvt_ground.config import check as check_ground
from hvt_ground.extras import config_class
from programs.processes import PATIENT_S, eventually

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
IMAGE_PATHS = {"/opt/hvt/router.py": DEPLOY / "router.py", "/opt/hvt/zenoh": DEPLOY / "zenoh"}
MODULES = {"hvt-edge": "hvt_edge.cli", "hvt-ground": "hvt_ground.cli"}


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    """The file with ``${NAME:-default}`` settled as in an empty environment."""
    text = (DEPLOY / "compose.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text))


def test_every_service_is_built_from_this_checkout_of_parts_that_exist(compose: dict[str, Any]) -> None:
    """Docker would look for an image of our name on the internet, or refuse an unknown volume or service.

    The router listens without keys: published on every address it would show the cameras to the network.
    """
    services = compose["services"]
    assert set(services) == {"router", "ground", "edge"}
    for service in services.values():
        context = (DEPLOY / service["build"]["context"]).resolve()
        assert (context / service["build"]["dockerfile"]).samefile(DEPLOY / "Dockerfile")
        assert (context / "pyproject.toml").is_file()
        assert set(service.get("depends_on", {})) <= set(services)
        assert {volume.split(":")[0] for volume in service.get("volumes", [])} <= set(compose["volumes"])
        assert service["stop_signal"] == "SIGINT"
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", []))
    assert services["edge"]["depends_on"]["router"]["condition"] == "service_healthy"
    assert "healthcheck" in services["router"]


def test_the_commands_are_accepted_by_the_real_parsers(compose, monkeypatch) -> None:
    """A renamed flag would end the container with code 2."""
    monkeypatch.syspath_prepend(DEPLOY)
    kinds = {
        "edge": EdgeConfig,
        "ground": config_class(),
        "router": importlib.import_module("router").RouterConfig,
    }
    programs, configs = {}, {}
    for name, kind in kinds.items():
        command = compose["services"][name]["command"]
        words = 2 if name == "router" else 1
        programs[name] = command[:words]
        configs[name], _ = load(kind, command[words:], program=name, description="")
    assert programs == {
        "edge": ["hvt-edge"],
        "ground": ["hvt-ground"],
        "router": ["python", "/opt/hvt/router.py"],
    }
    assert check_edge(configs["edge"]).source == "demo"
    assert check_ground(configs["ground"]).connect == configs["edge"].connect == ("tcp/router:7447",)
    assert (configs["router"].listen, configs["router"].insecure) == (("tcp/0.0.0.0:7447",), True)


def test_the_image_holds_what_the_commands_name(compose: dict[str, Any]) -> None:
    """Paths inside the image are made by the Dockerfile, a file away."""
    dockerfile = (DEPLOY / "Dockerfile").read_text(encoding="utf-8")
    for inside, outside in IMAGE_PATHS.items():
        assert f"COPY {outside.relative_to(DEPLOY.parent)} {inside}\n" in dockerfile
    for service in compose["services"].values():
        for word in service["command"]:
            if found := re.search(r"/opt/hvt/\S+", word):
                assert Path(_here(found[0], port=7447, recordings=Path())).exists(), word


@pytest.mark.integration
@pytest.mark.nightly
def test_the_commands_do_what_the_file_promises(
    compose: dict[str, Any], tmp_path: Path, free_port: int
) -> None:
    """Router, ground and edge with the very commands of the file: at the end there must be a recording."""

    @contextmanager
    def start(name: str, *more: str) -> Iterator[subprocess.Popen[bytes]]:
        words = [
            _here(word, port=free_port, recordings=tmp_path) for word in compose["services"][name]["command"]
        ]
        program = [sys.executable, "-m", MODULES[words[0]]] if words[0] in MODULES else [sys.executable]
        with subprocess.Popen([*program, *words[1:], *more], stdout=subprocess.DEVNULL) as process:
            try:
                yield process
            finally:
                process.kill()

    check = [_here(word, port=free_port, recordings=tmp_path) for word in _health(compose)]
    with start("router") as router:
        passed = partial(subprocess.run, [sys.executable, *check[1:]], check=False, capture_output=True)
        eventually(lambda: passed().returncode == 0, what="the health check passes")
        with start("ground", "--quiet", "--once", "--detector=motion", "--classifier=none") as ground:
            small = ("--max-frames=30", "--size=320x192", "--detector=motion", "--preset=ultrafast")
            with start("edge", "--quiet", "--wait=200s", "--pace=lockstep", *small) as edge:
                assert edge.wait(PATIENT_S) == 0
            assert ground.wait(PATIENT_S) == 0
        router.send_signal(signal.SIGINT)
        assert router.wait(PATIENT_S) == 0
    sent = json.loads((tmp_path / "edge.json").read_text())
    received = json.loads((tmp_path / "ground.json").read_text())
    assert 0 < sent["frames"] == received["frames_decoded"]
    assert sent["base_bytes"] == received["base_bytes"]
    assert [file.stat().st_size > 0 for file in tmp_path.glob("hvt-demo-*.rrd")] == [True]


def _health(compose: dict[str, Any]) -> list[str]:
    kind, *command = compose["services"]["router"]["healthcheck"]["test"]
    assert kind == "CMD"
    assert command[0] == "python"
    return command


def _here(word: str, *, port: int, recordings: Path) -> str:
    """A word of a command as it has to be outside of a container."""
    word = re.sub(r"tcp/(router|0\.0\.0\.0):7447", f"tcp/127.0.0.1:{port}", word).replace("7447", str(port))
    for inside, outside in IMAGE_PATHS.items():
        word = word.replace(inside, str(outside))
    return word.replace("/recordings", str(recordings))
