"""Options and commands of earlier versions: each is answered with what to write today."""

from __future__ import annotations

from pathlib import Path

import pytest

import hvt_study.cli

RENAMED = {
    ("--lend",): "--borrow-unused",
    ("--pulse", "2s"): "give --fps auto",
    ("--pulse-depth", "0.2"): "give --fps auto",
    ("--rolling", "5x3"): "give --fps auto",
    ("--rolling-depth", "0.2"): "give --fps auto",
}


@pytest.mark.parametrize("words", RENAMED, ids=lambda words: words[0])
def test_an_option_that_was_renamed_or_taken_out(refused, pictures, words):
    """A service file of last year would be answered with a list of sixty options to search."""
    sentence = refused("hvt-edge", "--source", pictures, *words)
    assert words[0] in sentence
    assert RENAMED[words] in sentence


@pytest.mark.parametrize("words", RENAMED, ids=lambda words: words[0])
def test_a_setting_in_a_file_that_was_renamed_or_taken_out(refused, pictures, words):
    """The same for who keeps the settings in a file."""
    name = words[0].removeprefix("--")
    value = f"'{words[1]}'" if words[1:] else "true"
    Path("edge.toml").write_text(f"{name} = {value}\n")
    sentence = refused("hvt-edge", "--source", pictures, "--config", "edge.toml")
    assert name in sentence
    assert RENAMED[words] in sentence


def test_a_study_command_that_was_renamed(here, capfd):
    """A script that compares methods would say that its command was never there."""
    assert hvt_study.cli.main(["sight", "clip.mp4"]) == 2, "it is the command, which wants to know more"
    out, err = capfd.readouterr()
    assert out == ""
    assert "sight is called compare" in err
    assert "hvt-study compare --help" in err
    assert list(here.iterdir()) == []
