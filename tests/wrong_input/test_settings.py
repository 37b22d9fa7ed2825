"""Each setting of both programs, as a flag and in a file, with values of a wrong kind."""

import dataclasses

import pytest

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_ground.extras import checked, config_class

WORDS = ("", "x", "-1", "nan", "inf", "1e400", "9" * 5000, "0x10", "1,5", "a\nb", "\udcff", "é" * 300, "[]")
VALUES = (
    *("-1", "nan", "inf", "9223372036854775807", "true", "1979-05-27"),
    *('""', r'"a\nb"', "[]", "[{}]", "{}"),
)


def fly_edge(words):
    config, given = load(EdgeConfig, words, program="hvt-edge", description="")
    check(with_profile(config, given=given.values))


def fly_ground(words):
    checked(load(config_class(), words, program="hvt-ground", description="")[0])


@pytest.mark.parametrize(("start", "kind"), [(fly_edge, EdgeConfig), (fly_ground, config_class())])
def test_every_setting_takes_a_value_or_is_named_in_the_refusal(start, kind, tmp_path):
    """A user would have a traceback, or a sentence about he knows not which of a hundred settings."""
    silent: list[str] = []

    def attempt(name, words):
        source = ["--source=demo"] if kind is EdgeConfig and name != "source" else []
        try:
            start([*source, *words])
        except UserError as error:
            if name not in str(error):
                silent.append(f"{words}: {error}")

    for name in (field.name.replace("_", "-") for field in dataclasses.fields(kind)):
        for word in WORDS:
            attempt(name, [f"--{name}={word}"])
        for value in VALUES:
            file = tmp_path / "settings.toml"
            file.write_text(f"{name} = {value}\n")
            attempt(name, ["--config", str(file)])
    assert not silent
