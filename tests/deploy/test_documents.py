"""What the documents name exists: files, flags, options, make targets; and a page is short enough to be read."""

import dataclasses
import importlib
import importlib.util
import re
from pathlib import Path

import pytest

from hvt_edge.config import EdgeConfig
from hvt_ground.extras import config_class

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(str(page.relative_to(ROOT)) for page in ROOT.glob("docs/**/*.md"))
DOCUMENTS = ("README.md", "CONTRIBUTING.md", *PAGES)
MOST_WORDS = 1200
# Of other programs, of every command, or of the makers of the settings themselves.
OTHER_FLAGS = {
    *[
        "--help",
        "--help-all",
        "--version",
        "--config",
        "--print-config",
        "--name",
        "--no-name",
        "--build",
        "--now",
    ],
    # Of programs that docs/small-boards.md starts.
    *["--codec", "--framerate", "--height", "--libav-format", "--python", "--user", "--width"],
}


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def _prose_words(text: str) -> int:
    """Words outside tables, lists of options and of fields, code and pictures."""
    text = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    lines = (
        line for line in text.splitlines() if not re.match(r"\||- `--|\d+\. `\w+` \(|    |<!--|!\[", line)
    )
    return sum(len(line.split()) for line in lines)


def _known_flags() -> set[str]:
    settings = {
        "--" + no + field.name.replace("_", "-")
        for config in (EdgeConfig, config_class())
        for field in dataclasses.fields(config)
        for no in ("", "no-")
    }
    sources = (
        path
        for room in ("common", "ground", "extras", "study", "lab", "bench", "deploy")
        for path in (ROOT / room).rglob("*.py")
    )
    declared = (re.findall(r'"(--[a-z][a-z0-9-]+)"', path.read_text(encoding="utf-8")) for path in sources)
    return settings.union(*declared)


@pytest.mark.parametrize("name", [*PAGES, "README.md", "CONTRIBUTING.md"])
def test_a_page_is_short(name: str) -> None:
    """Nobody reads to the end of what has no end."""
    assert _prose_words(_text(name)) <= MOST_WORDS


@pytest.mark.parametrize("name", DOCUMENTS)
def test_flags_exist(name: str) -> None:
    """A flag that is only in a document costs its reader a wrong start, and trust."""
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]+", _text(name)))
    assert named - _known_flags() - OTHER_FLAGS == set()


@pytest.mark.parametrize("name", [*DOCUMENTS, "CHANGELOG.md"])
def test_files_exist(name: str) -> None:
    """A path that leads nowhere ends the search of who followed it."""
    text = _text(name)
    pattern = r"\b(?:common|edge|ground|study|lab|deploy|docs|tests)/(?!\s)[\w./@*-]*\w/?"
    named = {found.rstrip("/") for found in re.findall(pattern, text.replace("/opt/hvt/src/", ""))}
    missing = {path for path in named if "/" in path and not any(ROOT.glob(path))}
    within = re.findall(r"`([\w/]+/\w+\.py)", text)  # a program or a room, such as hvt_edge/app.py
    missing |= {path for path in within if not any(any(ROOT.glob(up + path)) for up in ("", "*/", "*/*/"))}
    assert missing == set()


@pytest.mark.parametrize("name", [*DOCUMENTS, "CHANGELOG.md"])
def test_links_hold(name: str) -> None:
    """The reader of a manual page would not find the figures behind it."""
    broken = set()
    for link in re.findall(r"\]\((?!https?:)([^)]+)\)", _text(name)):
        file, _, anchor = link.partition("#")
        page = (ROOT / name).parent / file if file else ROOT / name
        if not page.exists() or (anchor and anchor not in _anchors(page)):
            broken.add(link)
    assert broken == set()


def _anchors(page: Path) -> set[str]:
    heads = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}


def test_pages_and_tests_named_in_the_code_exist() -> None:
    """A message or a docstring sends its reader to a page or a test that is gone."""
    files = (
        path
        for room in ("common", "edge", "ground", "extras", "study", "lab", "bench", "deploy")
        for path in (ROOT / room).rglob("*")
        if path.suffix in {".py", ".toml", ".service", ".yaml", ".json5"}
    )
    named = {
        (str(path.relative_to(ROOT)), page)
        for path in files
        for page in re.findall(r"(?:docs/[\w/-]+\.md|tests/[\w/-]+\.py)", path.read_text(encoding="utf-8"))
    }
    assert named, "the pattern finds nothing any more"
    assert {(path, page) for path, page in named if not (ROOT / page).exists()} == set()


def test_every_page_can_be_found() -> None:
    """A page that no other page links to does not exist for its reader."""
    reached, waiting = set(), ["README.md"]
    while waiting:
        name = waiting.pop()
        if name in reached:
            continue
        reached.add(name)
        links = re.findall(r"\]\((?!https?:)([^)#]+\.md)", _text(name))
        waiting += [str(((ROOT / name).parent / link).resolve().relative_to(ROOT)) for link in links]
    assert set(PAGES) - reached == set()


def test_every_option_is_documented(monkeypatch: pytest.MonkeyPatch) -> None:
    """An option would be known to those alone who read the code; `make docs` writes the page."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    page = importlib.import_module("options").page()
    assert _text("docs/options.md") == page, "the settings have changed: run `make docs`"


def test_make_targets_exist() -> None:
    """The first thing a contributor types."""
    targets = set(re.findall(r"^([a-z-]+):", _text("Makefile"), re.MULTILINE))
    named = {target for name in DOCUMENTS for target in re.findall(r"`make ([a-z-]+)\b", _text(name))}
    assert len(named) >= 5
    assert named <= targets
