"""The ground flies the same without its extras, and names the one that is missing."""

from __future__ import annotations

import pytest

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_ground.cli import main
from hvt_ground.config import GroundConfig, check
from hvt_ground.extras import all_extras, config_class


@pytest.mark.parametrize(
    ("words", "package"),
    [(["--cot", "udp://239.2.3.1:6969"], "cot"), (["--mcap=a.mcap"], "mcap"), (["--ts", "a.ts"], "ground")],
)
def test_a_setting_of_an_extra_that_is_absent(words, package):
    """It would be an unknown argument, as if there were no such thing."""
    core = config_class(())
    assert check(load(core, [], program="hvt-ground", description="")[0]) == check(core())
    with pytest.raises(UserError) as refused:
        load(core, words, program="hvt-ground", description="")
    name = words[0].partition("=")[0]
    assert str(refused.value) == (
        f"{name} is of an extra that is not installed: pip install 'hvt[{package}]'"
    )


def test_extras_bring_what_the_core_has_not():
    """Two of one name would hide each other."""
    settings = [one for extra in all_extras() for one in vars(extra.options)["__annotations__"]]
    assert sorted(settings) == ["cot", "cot_types", "mcap", "ts"]
    assert not set(settings) & set(GroundConfig.__annotations__)


@pytest.mark.parametrize("command", ["export", "keys", "replay"])
def test_a_command_of_an_extra_that_is_absent(command, monkeypatch, capsys):
    """It would be an unrecognised argument of the ground."""
    monkeypatch.setattr("hvt_common.runtime.plug_ins.installed", lambda _group: {})
    assert main([command]) == 2
    assert capsys.readouterr().err == (
        f"hvt-ground: hvt-ground {command} is of an extra that is not installed: pip install 'hvt[ground]'\n"
    )
