"""Every setting of hvt-edge."""

import dataclasses
import pwd
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from hvt_common.config import load, to_toml
from hvt_common.errors import UserError
from hvt_edge.config import EdgeConfig, check, note_on_share, with_profile
from hvt_edge.video.encoder import keyframe_floor_bytes


def read(*argv: str) -> tuple[EdgeConfig, Any]:
    return load(EdgeConfig, ["--source", "demo", *argv], program="hvt-edge", description="")


def settled(*argv: str) -> EdgeConfig:
    return check(read(*argv)[0])


def flown(*argv: str) -> tuple[EdgeConfig, Mapping[str, Any]]:
    """The settings that fly, with their profile, and the given ones."""
    config, given = read(*argv)
    return check(with_profile(config, given=given.values)), given.values


@pytest.mark.parametrize(
    ("given", "measures", "method", "codec"),
    [
        ([], True, "M6", "residual"),
        (["--still-codec", "jpeg"], True, "M6", "jpeg"),
        (["--method", "M3"], False, "M3", "jpeg"),
        (["--regime", "low"], False, "M5", "jpeg"),
        (["--regime", "low", "--profile", "auto"], True, "M6", "residual"),
        (["--profile", "thin"], False, "M6", "residual"),
    ],
)
def test_what_pays_is_measured_unless_a_method_is_asked_for(given, measures, method, codec):
    """A first user would get the paper's stills, which lose against plain video."""
    config, _ = flown(*given)
    assert (config.measures, config.method, config.still_codec) == (measures, method, codec)


def test_what_is_said_without_flags_is_the_low_regime():
    """The defaults of the manual would not be those of the program."""
    config = settled()
    assert (config.budget_bps, config.base_bps) == (800_000, 650_000)
    assert (config.size, config.fps, config.method) == (None, 15.0, "M5")
    others = (config.jpeg_quality, config.padding, config.cooldown, config.detect_every)
    assert others == (65, 0.15, 2.0, None)


@pytest.mark.parametrize(
    ("argv", "total", "base"),
    [
        (["--regime", "moderate"], 1_400_000, 1_200_000),
        (["--regime", "low"], 800_000, 650_000),
        (["--budget", "1Mbps"], 1_000_000, 812_500),
        (["--budget", "1Mbps", "--video-share", "0.5"], 1_000_000, 500_000),
        (["--video-share", "75%"], 800_000, 600_000),
        (["--method", "M0"], 800_000, 800_000),
        (["--method", "M0", "--regime", "moderate"], 1_400_000, 1_400_000),
    ],
)
def test_budget_regime_and_share_settle_to_two_rates(argv, total, base):
    """The drone would spend other bits than the user pays for."""
    config = settled(*argv)
    assert (config.budget_bps, config.base_bps) == (total, base)


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("--method M0 --video-share 0.8", "--video-share 0.8 does not count: method M0 sends video"),
        ("--profile tracks --video-share auto", "--video-share auto does not count: method M0"),
        *(
            (argv, "")
            for argv in ("--method M0 --video-share 1", "--method M5 --video-share 0.8", "--method M0")
        ),
        *((argv, "") for argv in ("--regime moderate", "")),
    ],
)
def test_a_share_that_does_not_count_is_said(argv, said):
    """Whoever gave it would look for the rest of the budget."""
    config, given = flown(*argv.split())
    note = note_on_share(config, given=given)
    assert note.startswith(said)
    assert bool(note) == bool(said)


@pytest.mark.parametrize("size", ["160x120", "320x180", "640x360", "1280x720", "1920x1080"])
@pytest.mark.parametrize("fps", ["2", "5", "15", "30", "auto"])
@pytest.mark.parametrize(
    "flags", [["--method", "M0"], ["--method", "M5"], ["--profile", "auto"], ["--window", "2s"]]
)
def test_a_budget_whose_window_holds_no_keyframe_is_refused_with_the_least_that_does(size, fps, flags):
    """The first second would be twice what the link carries, without a word."""
    argv = ["--size", size, "--fps", fps, *flags]
    with pytest.raises(UserError, match="give at least") as refused:
        settled(*argv, "--budget", "9kbps")
    words = str(refused.value).split("give at least ")[1].split()
    least_bps = round(float(words[0]) * (1e6 if words[1].startswith("M") else 1e3))
    config = settled(*argv, "--budget", f"{least_bps / 1000:.0f}kbps")
    wide, high = map(int, size.split("x"))
    assert config.budget_bps * config.window / 8 > keyframe_floor_bytes((wide, high))
    with pytest.raises(UserError, match="give at least"):
        settled(*argv, "--budget", f"{least_bps / 1000 - 2:.0f}kbps")


@pytest.mark.parametrize("option", ["source", "pose"])
def test_the_users_own_folder_may_be_written_short(option, monkeypatch, tmp_path):
    """No shell makes one of --source=~/clip.mp4, and the edge looked for a folder of the name ~."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert getattr(read(f"--{option}=~/flight")[0], option) == str(tmp_path / "flight")


@pytest.mark.parametrize("option", ["source", "pose"])
def test_a_user_without_a_folder_is_told_so(option, monkeypatch):
    """A container's user may have none, and --source=~/clip.mp4 ended the edge with a traceback."""
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", lambda _: {}["none"])
    with pytest.raises(UserError, match="'~/flight' begins with a user that this machine does not know"):
        read(f"--{option}=~/flight")


def test_the_short_help_is_short_and_grouped(capsys):
    """A first reader would look for --budget among sixty settings."""
    with pytest.raises(SystemExit):
        read("--help")
    out = capsys.readouterr().out
    flags = re.findall(r"^  (?:-h, )?--[a-z-]+", out, re.MULTILINE)
    assert 20 <= len(flags) <= 30
    for title in ("source:", "budget and link:", "what to send:", "models:", "files:"):
        assert f"\n{title}\n" in out
    assert "--help-all" in out
    assert "--nms-iou" not in out


def test_every_flag_explains_itself(capsys):
    """Somebody with a drone in the field would have to read the source."""
    with pytest.raises(SystemExit):
        read("--help-all")
    out = " ".join(capsys.readouterr().out.split())
    for one in dataclasses.fields(EdgeConfig):
        flag = "--" + one.name.replace("_", "-")
        assert flag in out
        assert len(one.metadata["help"]) > 8
        if one.metadata.get("switch"):
            continue
        shown = one.metadata["shown_default"] or one.default not in (None, ())
        optional = one.default is None or one.default == ()
        assert shown or optional, f"{flag} does not say its default"
    assert "[800kbps]" in out
    assert "[1280x720, less for a small source or a small --budget]" in out
    assert "[auto; 15.0 with --method/--regime]" in out, "a start without flags flies auto"
    assert "[yes; no with --method/--regime]" in out


def test_what_is_printed_starts_the_same_flight(tmp_path):
    """``--print-config`` could not be kept and flown again."""
    words = "--edge-id a-1 --size 640x362 --fps 12.5 --budget 1.2345Mbps --video-share 61% --window 1.5s --method R0"
    words += " --cooldown 0.1s --keyframe-interval 7s --connect tcp/[::1]:7447#so_sndbuf=8192 --quiet --max-frames 7"
    config, _ = read(*words.split(), "--source", 'a "quoted" ünïcode\\x clip.mp4')
    path = tmp_path / "edge.toml"
    path.write_text(to_toml(config), encoding="utf-8")
    back = load(EdgeConfig, ["--config", str(path)], program="hvt-edge", description="")[0]
    assert back == config
    assert check(back) == check(config)


def test_the_checked_settings_can_be_checked_again():
    """The study, which starts from settled settings, would be refused."""
    config = settled("--budget", "1Mbps")
    assert check(config) == config


def test_no_setting_is_accepted_and_ignored():
    """A flag that changes nothing is worse than none: its user believes in it."""
    import hvt_edge

    folder = Path(hvt_edge.__file__).parent
    code = {file: file.read_text(encoding="utf-8") for file in folder.rglob("*.py")}
    own = code.pop(folder / "config.py")  # its properties derive from settings
    others = "\n".join(code.values())
    names = [one.name for one in dataclasses.fields(EdgeConfig)]
    unread = [
        name
        for name in names
        if not re.search(rf"config\.{name}\b", others) and not re.search(rf"(config|self)\.{name}\b", own)
    ]
    assert unread == []


def test_the_least_gain_reaches_the_suppression():
    """`--min-gain` decides how much bits go to tracks that look the same as before."""
    from hvt_edge.wiring.perception import make_suppression

    assert make_suppression(settled("--min-gain", "3")).min_gain == 3
    assert make_suppression(settled("--cooldown", "0")).min_gain == 1


def test_a_frame_rate_that_the_window_does_not_hold_is_refused_by_its_name():
    """Who gave --fps 1 was told that a --window, which he had not given, is wrong; and the one to give was, too."""
    with pytest.raises(UserError, match=r"--window 1s is shorter .* of --fps 1.5: give --window 1\.334s or"):
        settled("--fps", "1.5")
    assert settled("--fps", "1.5", "--window", "1.334s").window == 1.334
