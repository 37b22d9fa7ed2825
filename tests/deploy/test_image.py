"""The Dockerfile, read line by line, and the wheel that it would install, built from what it copies."""

import fnmatch
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = ROOT / "deploy" / "Dockerfile"
INSTRUCTIONS = {
    "ADD", "ARG", "CMD", "COPY", "ENTRYPOINT", "ENV", "EXPOSE", "FROM", "HEALTHCHECK", "LABEL", "RUN", "SHELL",
    "STOPSIGNAL", "USER", "VOLUME", "WORKDIR",
}  # fmt: skip


def _instructions() -> list[tuple[str, str]]:
    text = DOCKERFILE.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in lines]


def _copies() -> list[tuple[list[str], str]]:
    """(sources in the checkout, destination) of each COPY."""
    words = [shlex.split(rest) for name, rest in _instructions() if name == "COPY"]
    return [(one[:-1], one[-1]) for one in words if not one[0].startswith("--from")]


def test_instructions_are_known_and_start_from_a_python_that_we_support() -> None:
    """A misspelt instruction ends the build on the user's machine, where we do not see it."""
    instructions = _instructions()
    assert {name for name, _ in instructions} <= INSTRUCTIONS
    assert instructions[0][0] == "FROM"
    assert {rest.split()[0] for name, rest in instructions if name == "FROM"} == {"python:3.11-slim"}
    assert ("USER", "hvt") in instructions
    assert ("STOPSIGNAL", "SIGINT") in instructions


def test_everything_copied_is_there_and_not_ignored() -> None:
    """COPY of a missing or ignored file ends the build."""
    rules = (ROOT / "deploy" / "Dockerfile.dockerignore").read_text(encoding="utf-8").split()
    assert rules[0] == "*"
    let_in = [rule[1:] for rule in rules if rule.startswith("!")]
    sources = [source.removeprefix("./") for group, _ in _copies() for source in group]
    for source in sources:
        assert (ROOT / source).exists(), source
        assert any(fnmatch.fnmatch(source, rule) for rule in let_in), f"{source} is not in the build context"
    assert {rule for rule in let_in if not (ROOT / rule).exists()} == set()


def test_extras_are_those_of_the_distribution() -> None:
    """For an extra that does not exist pip only warns, and leaves Rerun out."""
    extras = dict(rest.split("=") for name, rest in _instructions() if name == "ARG")["EXTRAS"].split(",")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(extras) <= set(project["optional-dependencies"])


def test_what_is_copied_builds_the_wheel(tmp_path: Path) -> None:
    """Hatchling leaves out a package that was not copied, and says nothing: its commands would fail in the air."""
    pytest.importorskip("hatchling", reason="hatchling is not installed: nothing to build a wheel with")
    for sources, destination in _copies():
        if destination.startswith("/"):
            continue  # after the install
        for source in sources:
            target = tmp_path / destination / ("" if (ROOT / source).is_dir() else source)
            if (ROOT / source).is_dir():
                shutil.copytree(ROOT / source, target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / source, target)
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = (tmp_path / "out").iterdir()
    names = set(zipfile.ZipFile(wheel).namelist())
    build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    packages = {Path(one).name for one in build["targets"]["wheel"]["packages"]}
    assert packages <= {name.split("/")[0] for name in names}
    (scripts,) = (name for name in names if name.endswith("entry_points.txt"))
    assert "hvt-edge = hvt_edge.cli:program" in zipfile.ZipFile(wheel).read(scripts).decode()
