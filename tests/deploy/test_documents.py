"""What the documents name exists: files, flags, make targets."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from hvt_edge.config import EdgeConfig
from hvt_ground.config import GroundConfig

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = ("docs/deployment.md", "CONTRIBUTING.md", "CHANGELOG.md")
# Of other programs, or of every command.
OTHER_FLAGS = {"--help", "--config", "--print-config", "--build", "--now", "--accounting", "--out"}


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", DOCUMENTS)
def test_flags_exist(name: str) -> None:
    """A flag that is only in a document costs its reader a wrong start, and trust."""
    known = {
        "--" + field.name.replace("_", "-")
        for config in (EdgeConfig, GroundConfig)
        for field in dataclasses.fields(config)
    }
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", _text(name)))
    assert named - known - OTHER_FLAGS == set()


@pytest.mark.parametrize("name", DOCUMENTS)
def test_files_exist(name: str) -> None:
    """The table of where a change belongs is useless from the first renamed file on."""
    text = _text(name)
    pattern = r"\b(?:common|edge|ground|study|deploy|docs|tests)/(?!\s)[\w./@*-]*\w/?"
    named = {found.rstrip("/") for found in re.findall(pattern, text.replace("/opt/hvt/src/", ""))}
    assert named, "the pattern finds nothing any more"
    missing = {path for path in named if not any(ROOT.glob(path))}
    assert missing == set()
    links = {link.partition("#")[0] for link in re.findall(r"\]\((?!https?:)([^)]+)\)", text)}
    assert {link for link in links if not ((ROOT / name).parent / link).exists()} == set()


def test_make_targets_exist() -> None:
    """The first thing a contributor types."""
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"`make ([a-z]+)`", _text("CONTRIBUTING.md")))
    assert len(named) >= 5
    assert named <= targets


def test_the_documented_configuration_is_the_sample() -> None:
    """Numbers of the text that follow from the sample file have to follow it when it changes."""
    sample = _text("deploy/config/edge.toml")
    assert 'budget = "250kbps"' in sample
    assert "video-share = 0.8\n" in sample
    assert "`--budget 250kbps --video-share 0.8`" in _text("docs/deployment.md")
