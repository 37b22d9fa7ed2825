"""What a test of processes tells where it fails: on a machine that nobody sees, it is all there is."""

from __future__ import annotations

import pytest

from programs.processes import Link, Sessions, agree


def test_two_sessions_where_one_was_expected_are_both_told():
    """A ground that began a second session would be seen as an error of types."""
    left = Sessions([{"session": name, "frames": 7, "failed": [{"reason": "full"}]} for name in ("a", "b")])
    left.said = "disk full"
    with pytest.raises(
        AssertionError, match=r"(?s)2 sessions.*\('b', 7, \[\{'reason': 'full'\}\]\).*disk full"
    ):
        agree({"frames": 14, "failed": []}, left)  # type: ignore[arg-type]


@pytest.mark.nightly
def test_a_failure_tells_what_the_programs_said(tmp_path):
    """Nobody would know why the edge was not there."""
    with pytest.raises(AssertionError) as caught, Link(tmp_path) as link:
        link.edge("--budget", "much").until("listening")
    assert "budget" in "".join(caught.value.__notes__)
