"""Settings from defaults, a file and flags."""

import dataclasses
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.config import (
    BITRATE,
    DURATION,
    PATH,
    SHARE,
    SIZE,
    TEXT,
    Group,
    choice,
    integer,
    load,
    number,
    to_toml,
)
from hvt_common.errors import UserError

_ALL = Group()


@dataclass(frozen=True, slots=True)
class Camera:
    """One field of each kind."""

    source: str | None = _ALL.option(TEXT, None, "where frames come from")
    budget: int = _ALL.option(BITRATE, 800_000, "all of it")
    wait: float = _ALL.option(DURATION, 1.5, "how long")
    share: float = _ALL.option(SHARE, 0.5, "100% of it")
    size: tuple[int, int] = _ALL.option(SIZE, (64, 48), "in pixels")
    frames: int = _ALL.option(integer(1, 9, unit=" frames"), 5, "how many")
    gain: float = _ALL.option(number(0, 2), 1.0, "factor")
    fit_mode: str = _ALL.option(choice("crop", "letterbox"), "crop", "how")
    listen: tuple[str, ...] = _ALL.option(TEXT, (), "endpoints", many=True)
    file: Path | None = _ALL.option(PATH, None, "to write")  # noqa: RUF009 - as in config.py
    loud: bool = _ALL.switch("say more")


def read(*argv):
    return load(Camera, list(argv), program="camera", description="A camera.")[0]


def read_file(folder, text, *argv):
    path = folder / "camera.toml"
    path.write_text(text, encoding="utf-8")
    return read("--config", str(path), *argv)


def test_flags_go_over_the_file_and_the_file_over_defaults(tmp_path):
    """A flag for one flight would be overruled by the file in the drone, or the file by what is built in."""
    text = 'budget = "300kbps"\nframes = 7\nlisten = ["tcp/a:1", "tcp/b:2"]\nloud = true\n'
    config = read_file(tmp_path, text, "--frames", "9", "--no-loud")
    assert (config.budget, config.frames, config.gain, config.loud) == (300_000, 9, 1.0, False)
    assert config.listen == ("tcp/a:1", "tcp/b:2")
    assert read_file(tmp_path, text, "--listen", "tcp/c:3").listen == ("tcp/c:3",)
    assert read_file(tmp_path, text).loud is True
    assert read() == Camera()


def test_a_file_may_hold_plain_numbers_and_either_spelling(tmp_path):
    """TOML has numbers of its own; to have to quote them would be a surprise."""
    dots = "a." * 400
    config = read_file(
        tmp_path,
        f"# {dots}\nsource = '{dots}' # {dots}\n"
        'budget = 300000\nwait = 2\ngain = 0.25\nfit_mode = "letterbox"\nlisten = "tcp/a:1"\n',
    )
    assert (config.budget, config.wait, config.gain) == (300_000, 2.0, 0.25)
    assert (config.fit_mode, config.listen) == ("letterbox", ("tcp/a:1",))
    assert read_file(tmp_path, 'fit-mode = "letterbox"').fit_mode == "letterbox"


def test_what_was_set_is_told_apart_from_what_was_not(tmp_path):
    """A default that depends on another setting would overrule what the user said."""
    path = tmp_path / "camera.toml"
    path.write_text("frames = 5\n")
    _, asked = load(
        Camera, ["--config", str(path), "--gain", "1", "--print-config"], program="camera", description=""
    )
    assert dict(asked.values) == {"frames": 5, "gain": 1.0}
    assert asked.print_config


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("budgte = 1", "unknown key 'budgte': did you mean budget?"),
        ("fitmode = 'crop'", "did you mean fit-mode?"),
        ("BUDGET = 1", "unknown key 'BUDGET': did you mean budget?"),
        ("zzz = 1", "unknown key 'zzz': a key is an option without its two dashes"),
        ("fit_mode = 'crop'\nfit-mode = 'crop'", "has fit-mode twice"),
        ("frames = 5.0", "frames in .* '5.0' is not accepted: give a whole number from 1 to 9 frames"),
        ("frames = true", "frames in .* True is not accepted: give one value"),
        ("frames = [1]", r"frames in .* \[1\] is not accepted: give one value"),
        ("[frames]\nx = 1", "frames in .* is not accepted: give one value"),
        ("listen = [true]", "listen in .* True is not accepted"),
        ("listen = [['a']]", "listen in .* is not accepted: give one value"),
        ("listen = {a = 1}", "listen in .* is not accepted: give one value"),
        ("loud = 1", "loud in .* 1 is not accepted: give true or false"),
        ("source = ''", "source in .* is empty"),
        ("source = true", "source in .* True is not accepted"),
        ('source = "a\\u0000b"', "source in .* has a character"),
        ("file = '~nobody-of-that-name/x'", "begins with a user that this machine does not know"),
        ("budget = nan", "is not a bitrate"),
        ("gain = inf", "give a number from 0 to 2"),
        ("wait = -1", "is not a duration"),
        ("budget = ", "is not valid TOML"),
        ("a = 1\na = 2", "is not valid TOML"),
        pytest.param(f"a = {'[' * 9999}", "is not valid TOML", id="deep"),
        pytest.param("a = {" + "'b' ." * 99_999 + "b = 1}", "the key _ ._", id="a key of quoted parts"),
        pytest.param("a=1\n" * 300_000, "it has 1200000 characters, accepted", id="large"),
        pytest.param(
            "a." * 99_999 + "b = 1",
            "the key a.a.a.a.a.a.a.a.a.a.… has more than 32 parts",
            id="a key of many parts",
        ),
    ],
)
def test_a_wrong_file_is_one_sentence(tmp_path, text, said):
    """The user would get a traceback, or a flight with another setting than the file's."""
    with pytest.raises(UserError, match=said):
        read_file(tmp_path, text)


def test_a_file_that_cannot_be_read_is_one_sentence(tmp_path):
    """The user would see a traceback for a typo in a name."""
    (binary := tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    for path, said in (
        (tmp_path / "none", "does not exist"),
        (tmp_path, "cannot be"),
        (binary, "cannot be read"),
    ):
        with pytest.raises(UserError, match=said):
            read("--config", str(path))


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--frames", "-1"], "--frames '-1' is not accepted"),
        (["--frames"], "expected one argument"),
        (["--fram", "1"], "unrecognized arguments"),  # no abbreviations: they change with every new flag
        (["clip.mp4"], "unrecognized arguments: clip.mp4"),
        (["--fit-mode", "stretch"], "choose one of crop, letterbox"),
        (["--loud=yes"], "argument --loud/--no-loud: 'yes' is given, and it takes no value"),
    ],
)
def test_a_wrong_flag_is_one_sentence(argv, said):
    """The user would get a page of usage in place of what is wrong."""
    with pytest.raises(UserError, match=said):
        read(*argv)


def test_help_says_unit_and_default_of_every_flag(capsys):
    """Whoever starts it for the first time would have to read the code."""
    for asked in ("--help", "--version"):
        with pytest.raises(SystemExit) as end:
            read(asked)
        assert end.value.code == 0
    out = " ".join(capsys.readouterr().out.split())
    shown = (
        "[800kbps],[1.5s],[0.5],[64x48],[5],[crop],100% of it,--no-loud,camera 0.,--fit-mode crop|letterbox"
    )
    assert [one for one in shown.split(",") if one not in out] == []


_TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1).filter(str.strip)


@given(
    st.builds(
        Camera,
        source=st.none() | _TEXTS,
        budget=st.integers(1, 10**9),
        wait=st.floats(0, 1e7),
        share=st.floats(0, 1),
        size=st.tuples(st.integers(0, 99_999), st.integers(0, 99_999)),
        frames=st.integers(1, 9),
        gain=st.floats(0, 2),
        fit_mode=st.sampled_from(["crop", "letterbox"]),
        listen=st.lists(_TEXTS).map(tuple),
        file=st.none() | st.from_regex(r"[\w ./-]{1,20}[\w]", fullmatch=True).map(Path),
        loud=st.booleans(),
    )
)
def test_what_is_printed_reads_back_the_same(tmp_path_factory, config):
    """``--print-config > file`` would start another flight than the one it was printed from."""
    text = to_toml(config)
    tomllib.loads(text)
    path = tmp_path_factory.getbasetemp() / "printed.toml"
    path.write_text(text, encoding="utf-8", newline="")
    back = read("--config", str(path))
    for one in dataclasses.fields(Camera):
        assert getattr(back, one.name) == getattr(config, one.name), one.name
