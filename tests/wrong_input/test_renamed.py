"""A command of an earlier version is answered with what to write today."""

from __future__ import annotations

import pytest

import hvt_study.cli


@pytest.mark.parametrize(
    ("words", "today"),
    [("sight clip.mp4", "compare"), ("score a.csv", "export --to mot"), ("track a.txt", "replay")],
)
def test_a_study_command_that_has_gone(here, capfd, words, today):
    """A script would say that its command was never there."""
    assert hvt_study.cli.main(words.split()) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert today in err
    assert list(here.iterdir()) == []
