"""Which class is of which type: the table that comes with it, and a user's."""

from __future__ import annotations

import pytest

from hvt_common.errors import UserError
from hvt_gateways.cot.type_table import default_types, read_types


def test_classes_have_types_and_nobody_is_an_enemy():
    """The map would show what no detector knows: whose it is."""
    types = default_types()
    found = {name: types.of_class(name) for name in ("car", "Van", "pedestrian", "boat", "moving", "zebra")}
    assert found == {
        "car": "a-u-G-E-V-C",
        "Van": "a-u-G-E-V-C",
        "pedestrian": "a-u-G",
        "boat": "a-u-S",
        "moving": "a-u-G",
        "zebra": "a-u-G",
    }
    assert types.of_edge("uav-1") == "a-f-A-M-H-Q"
    assert all(one.startswith("a-u-") for one in types.classes.values())


def test_rows_of_the_user_go_before_ours(tmp_path):
    """Who knows more than the detector could not say it."""
    file = tmp_path / "types.toml"
    file.write_text(
        '[classes]\nCar = "a-n-G-E-V-C"\n"pickup truck" = "a-h-G"\n"*" = "a-p-G"\n'
        '[platforms]\n"rover-*" = "a-f-G-E-V"\n"*" = "a-f-A"\n'
    )
    types = read_types(file)
    assert types.of_class("car") == "a-n-G-E-V-C"
    assert types.of_class("pickup truck") == "a-h-G"
    assert types.of_class("boat") == "a-u-S", "what it does not name is as it was"
    assert types.of_class("zebra") == "a-p-G"
    assert (types.of_edge("rover-2"), types.of_edge("uav-1")) == ("a-f-G-E-V", "a-f-A")
    assert read_types(None) == default_types()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[classes]\ncar = 3\n", "[classes] car = '3' is no Cursor on Target type"),
        (b'[classes]\ncar = "a-u-G E"\n', "[classes] car = 'a-u-G E' is no"),
        (b'[classes]\ncar = "a_u_G"\n', "[classes] car = 'a_u_G' is no"),
        (b'[classes]\ncar = ""\n', "[classes] car = '' is no"),
        (b'[classes]\ncar = "' + b"a-" * 40 + b'a"\n', "is no Cursor on Target type"),
        (b'[platforms]\n"*" = ["a"]\n', "[platforms] * = "),
        (b'car = "a-u-G"\n', "'car' is not known: give the tables [classes] and [platforms]"),
        (b'[types]\ncar = "a-u-G"\n', "'types' is not known"),
        (b"classes = 3\n", "[classes] is no table"),
        (b'[classes]\n"" = "a-u-G"\n', "a name has 1 to 128 characters"),
        (b"car: a-u-G\n", "is no TOML"),
        (b"\xff\xff", "not UTF-8 text"),
        (b"x = " + b"[" * 100_000, "is no TOML"),
        (b"#" * (2**20 + 1), "larger than 1 MB"),
    ],
)
def test_a_wrong_table_is_refused_in_one_sentence(tmp_path, content, said):
    """Every object of the flight would be something else, and nobody would know why."""
    file = tmp_path / "types.toml"
    file.write_bytes(content)
    with pytest.raises(UserError) as refusal:
        read_types(file)
    text = str(refusal.value)
    assert said in text
    assert str(file) in text
    assert len(text) < 400 + len(str(file))


def test_a_table_that_is_not_there(tmp_path):
    """A traceback would not name the option."""
    with pytest.raises(UserError, match=r"--cot-types .* cannot be read .No such file"):
        read_types(tmp_path / "nowhere.toml")
