"""One word for one thing, and the word that the field already uses."""

import ast
import re
import subprocess
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# What no text of the project says any more, code, comments, documents and tables alike.
_NEVER = re.compile(
    r"\b(asked_cut|beliefs?|cadences?|every_n|eyes|fates?|few_heaps|give_way|haves|hearsay|journals?|knees?|lends?|lent|levers?|"
    r"lendable|lived_time|numbers_seen|own_ns|pulses?|pulsed|purses?|report_back|rivals?|same_id|sights?|still_numbers|"
    r"swallow(s|ed|ing)?|ticks?|unchanging|whereabouts|wish(es|ed)?|workshops?)\b",
    re.IGNORECASE,
)
# Good English, and no names: each of these once stood for something that has a term.
_ONCE_NAMES = """
ask asked asker asking asks away belief beliefs cadence carried cut cuts draft drafts eyes fate fates fold
folded folding folds follow followed follower followers following follows have haves hear heard hearing hears
journal keep keeps kept knee lend lender lends listens look looks past piece pieces price pulse pulses purse
renew renewal reopen reopening rival rivals room scales sealed see sees settled sight speak speaks swallow
swallowed tick ticks told unchanging waiting weigh weighed whereabouts wish wished wishes workshop
"""
_NO_NAME = frozenset(_ONCE_NAMES.split())
_NO_CLASS = frozenset({"Early", "Row", "Seen"})
_OF_LIBRARIES = """
on_tick
ask haveImageWriter in_waiting keep_blank_values keep_trailing_newline
set_log_tick_enabled set_xticks set_yticks tick_params tick_values timeout_keep_alive xticks yticks
"""
_LIBRARIES_SAY = frozenset(_OF_LIBRARIES.split())
_OPTIONS = frozenset({"follow", "keep", "keep_video"})
"""As `tail` and FFmpeg call it, and restic what retention leaves: a setting's name is its flag's."""
_PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z0-9]+")


def _tracked(*patterns):
    listed = subprocess.run(
        ["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("this is no git checkout: nothing says which files are the project's")
    left_out = ("CHANGELOG.md", "tests/test_vocabulary.py", "tests/wrong_input/test_renamed.py", "LICENSE")
    return [one for one in listed.stdout.split() if one not in left_out and "imagenet" not in one]


def _forbidden(name):
    if name in _LIBRARIES_SAY | _OPTIONS:
        return False
    parts = {part.lower() for part in _PARTS.findall(name)}
    return bool(parts & _NO_NAME) or name.strip("_") in _NO_CLASS


def _names(file):
    with (ROOT / file).open("rb") as source:
        for token in tokenize.tokenize(source.readline):
            if token.type == tokenize.NAME and not token.string.startswith("test_"):
                yield token.start[0], token.string


def test_words_that_went_stay_away():
    """A newcomer would have to learn a private language again."""
    found = []
    for file in _tracked("*.py", "*.md", "*.toml", "Makefile", "*.yaml", "*.service"):
        for number, line in enumerate((ROOT / file).read_text(encoding="utf-8").splitlines(), 1):
            said = "" if "former name" in line else line
            for name in _LIBRARIES_SAY:
                said = said.replace(name, "")
            found += [f"{file}:{number}: {match[0]}" for match in _NEVER.finditer(said)]
    assert not found, f"{len(found)} words that shared terms replace:\n" + "\n".join(found)


def _prose(file):
    # Docstrings, also those behind constants and fields, and comments.
    source = (ROOT / file).read_text(encoding="utf-8")
    yield from (match[0] for match in re.finditer(r"(^|  )# .*", source, re.MULTILINE))
    for node in ast.walk(ast.parse(source)) if "what" in source else ():
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield str(node.value.value)


def test_prose_names_its_things():
    """A sentence about what came of what was left is a riddle: a noun says which thing is meant."""
    packages = [f"{one}/*.py" for one in ("common", "edge", "ground", "extras", "study", "lab", "bench")]
    found = [
        f"{file}: {text}"
        for file in _tracked(*packages)
        for text in _prose(file)
        if re.search(r"\bwhat\b", text, re.IGNORECASE)
    ]
    assert len(found) <= 20, "say which thing, not what:\n" + "\n".join(found)


def test_names_are_terms_of_the_field():
    """Who knows GStreamer, an RTP RFC or a ROS package would not recognise a part by its name."""
    found = {
        f"{file}:{number}: {name}"
        for file in _tracked(
            "common/*.py", "edge/*.py", "ground/*.py", "extras/*.py", "study/*.py", "bench/*.py", "lab/*.py"
        )
        for number, name in _names(file)
        if _forbidden(name)
    }
    assert not found, f"{len(found)} names that shared terms replace:\n" + "\n".join(sorted(found))
