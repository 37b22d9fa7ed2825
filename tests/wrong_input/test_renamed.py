"""A command of an earlier version is answered with what to write today."""

import hvt_study.cli


def test_a_study_command_that_was_renamed(here, capfd):
    """A script that compares methods would say that its command was never there."""
    assert hvt_study.cli.main(["sight", "clip.mp4"]) == 2, "it is the command, which wants to know more"
    out, err = capfd.readouterr()
    assert out == ""
    assert "sight is called compare" in err
    assert "hvt-study compare --help" in err
    assert list(here.iterdir()) == []
