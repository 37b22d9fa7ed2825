"""Every word of the code has one for people."""

import re
from pathlib import Path
from typing import get_args

from hvt_common.protocol.edge_words import (
    DECISION_WORDS,
    FRAME_GROUPS,
    PART_WORDS,
    STILL_WORDS,
    FrameGroup,
    counts_text,
    decision_sentences,
)
from hvt_ground.perception.stills.match import Outcome

ROOT = Path(__file__).parents[3]
EMITTED = (
    ("edge/hvt_edge/stills", r'NoStill\(\s*"(\w+)"'),
    ("edge/hvt_edge/stills", r'_refuse\([^)]*?"(\w+)"'),
    ("edge/hvt_edge", r'(?:on_outcome|record_outcome)\(\s*"\w+",\s*"(\w+)"'),
    ("edge/hvt_edge", r'on_outcome\([^)]*?else "\w+", "(\w+)"'),
    ("edge/hvt_edge/stills/policy", r'reason="(\w+)"'),
    ("edge/hvt_edge/stills/scheduler.py", r'return "(\w+)"'),
    ("edge/hvt_edge/stills/outbox.py", r'_expire\([^"]*?"(\w+)"'),
    ("edge/hvt_edge/stills/outbox.py", r'^AGAIN = "(\w+)"'),
    ("edge/hvt_edge/stills/on_demand.py", r'^ON_DEMAND = "(\w+)"'),
    ("edge/hvt_edge/stills/maker.py", r"reason: Literal\[(.*)\]"),
    ("ground/hvt_ground/perception", r'(?:dropped|outcomes)\["([\w ]+)"\]'),
)

PARTS = (
    ("edge/hvt_edge", r"^\w*PART(?:: Final)?(?:, \w+)? = (.*)$"),
    ("edge/hvt_edge", r"(?:Awaited|Retried\w*)\([^\"]*?\"([\w ]+)\""),
    ("common/hvt_common", r"(?:Awaited|Retried)\([^\"]*?\"([\w ]+)\""),
    ("extras/hvt_models/detectors/ensemble.py", r"^_PART_NAMES = (.*)$"),
    ("extras/hvt_archive/local_copy.py", r"^_PART = (.*)$"),
    ("extras/hvt_codecs", r"^_PART = (.*)$"),
    ("extras/hvt_fleet/health/server.py", r"Awaited\([^\"]*?\"([\w ]+)\""),
    ("edge/hvt_edge/link/publisher.py", r"self\._answered\(Channel\.(\w+)"),
)
"""Where a part of the edge that fails has its name from."""


def words(place, pattern):
    """All that this place of the tree can say."""
    path = ROOT / place
    files = [path] if path.is_file() else sorted(path.rglob("*.py"))
    found = {one for file in files for one in re.findall(pattern, file.read_text(), re.MULTILINE)}
    return {word for one in found for word in re.findall(r"[\w ]+", one) if word.strip()}


def test_each_reason_that_the_code_can_give_is_said_in_plain_words():
    """The end would say ``49 base_good``, and who flies look it up in the source."""
    for place, pattern in EMITTED:
        if "else" not in pattern:
            assert words(place, pattern), f"nothing of {place} says {pattern}"
        missing = words(place, pattern) - STILL_WORDS.keys()
        assert not missing, f"{place} says {missing}"
    assert set(get_args(Outcome)) <= STILL_WORDS.keys()
    assert not any("_" in said for said in STILL_WORDS.values())
    assert (
        counts_text({"base_good": 2, "border": 1})
        == "2 the video already shows well, 1 cut by the picture's edge"
    )


def test_each_part_of_an_edge_that_may_fail_has_a_name_for_people():
    """``at the edge: source has not worked since 12:00`` would stand before who flies."""
    found = {name.lower() for place in PARTS for name in words(*place)}
    assert found == PART_WORDS.keys()


def test_what_auto_decides_is_said_in_sentences():
    """The status line would be code; a word of a later version is said as it is."""
    said = {
        "no tracks: not measured yet; stills show details, they name 1 of 2 otherwise": [
            "The edge sends no tracks: not measured yet.",
            "Stills are sent for their details: they name 1 of 2 otherwise.",
        ],
        "video alone: this machine is too slow": ["Video alone is sent: this machine is too slow."],
        "maps: of snow; all is well": ["Maps: of snow.", "All is well."],
        "": [],
    }
    assert {one: decision_sentences(one) for one in said} == said
    assert all(words[0].isupper() for words in DECISION_WORDS.values())


def test_the_page_has_all_words_of_a_summary():
    """Who reads the JSON would find words that nothing explains."""
    page = (ROOT / "docs" / "summary.md").read_text()
    rows = dict(re.findall(r"^- `([^`]+)`: (.+)$", page, re.MULTILINE))
    groups = {name: said.format(frame_rate="the frame rate") for name, said in FRAME_GROUPS.items()}
    assert set(get_args(FrameGroup)) == groups.keys()
    assert groups.items() <= rows.items()
    assert STILL_WORDS.items() <= rows.items()
