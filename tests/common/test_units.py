"""Quantities as people write them."""

from __future__ import annotations

import pytest

from hvt_common.errors import UserError
from hvt_common.units import (
    Limit,
    bitrate_text,
    parse_bitrate,
    parse_duration_s,
    parse_limit,
    parse_share,
    parse_size,
)


@pytest.mark.parametrize(
    ("text", "bps"),
    [
        ("800kbps", 800_000),
        ("0.8Mbps", 800_000),
        ("0.8 Mbit/s", 800_000),
        ("800000", 800_000),
        ("800k", 800_000),
        (".8M", 800_000),
        ("1m", 1_000_000),
        ("1.", 1),
        ("64 bps", 64),
        ("1000Mbps", 1_000_000_000),
    ],
)
def test_bitrates(text, bps):
    """The budget of a flight would be a thousandth or a thousand times of what was meant."""
    assert parse_bitrate(text, name="--budget") == bps


@pytest.mark.parametrize(
    "text", ["", "fast", "-1", "0", "0.4", "1Gbps", "2000M", "1e6", "8 00k", "1,5M", "kbps", "nan"]
)
def test_what_is_no_bitrate_is_one_sentence(text):
    """A slip of the pen would start a flight with some other budget, or end in a traceback."""
    with pytest.raises(UserError, match=r"^--budget .* is not a bitrate: write 800kbps"):
        parse_bitrate(text, name="--budget")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("2s", 2.0), ("500ms", 0.5), ("1min", 60.0), ("1m", 60.0), ("2h", 7200.0), ("0", 0.0), ("1.5", 1.5)],
)
def test_durations(text, seconds):
    """A cooldown would last milliseconds or hours."""
    assert parse_duration_s(text, name="--cooldown") == seconds


@pytest.mark.parametrize("text", ["", "-1s", "2 parsecs", "1e3", "inf", "9" * 400, "20000000s", "s"])
def test_what_is_no_duration_is_one_sentence(text):
    """An endless duration would crash the process where it becomes nanoseconds."""
    with pytest.raises(UserError, match=r"^--cooldown .* is not a duration: write 2s"):
        parse_duration_s(text, name="--cooldown")


def test_sizes():
    """The base stream would have another size than asked for."""
    assert parse_size("1280x720", name="--size") == (1280, 720)
    assert parse_size(" 640 X 360 ", name="--size") == (640, 360)
    for wrong in ("", "1280", "x720", "1280x", "-1x2", "9999999999x1", "1280*720", "1280x720x3"):
        with pytest.raises(UserError, match=r"^--size .* is not a size: write WIDTHxHEIGHT"):
            parse_size(wrong, name="--size")


def test_shares():
    """Video would get all of the budget or none."""
    assert parse_share("0.8125", name="--video-share") == 0.8125
    assert parse_share("81.25%", name="--video-share") == 0.8125
    assert parse_share("1", name="--video-share") == 1.0
    for wrong in ("", "%", "2", "-0.1", "101%", "50%%", "nan", "half"):
        with pytest.raises(UserError, match=r"^--video-share .* is not a share"):
            parse_share(wrong, name="--video-share")


@pytest.mark.parametrize(
    ("bps", "text"),
    [
        (800_000, "800 kbps"),
        (1_400_000, "1.40 Mbps"),
        (12_345, "12 kbps"),
        (0, "0 kbps"),
        (999_499, "999 kbps"),
    ],
)
def test_bitrates_are_shown_with_three_digits(bps, text):
    """The status line would say a rate that nobody can read."""
    assert bitrate_text(bps) == text


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("1h", Limit(seconds=3600.0)),
        ("14 days", Limit(seconds=1_209_600.0)),
        ("2weeks", Limit(seconds=1_209_600.0)),
        ("500MB", Limit(size_bytes=500_000_000)),
        ("1.5tb", Limit(size_bytes=1_500_000_000_000)),
    ],
)
def test_a_limit_is_an_age_or_an_amount(text, limit):
    """Two weeks would be two seconds, or the settings that are printed could not be read again."""
    assert parse_limit(text, name="--keep") == limit
    assert parse_limit(str(limit), name="--keep") == limit


@pytest.mark.parametrize("wrong", ["", "0", "14", "0.5s", "999kB", "3parsecs", "-1h", "1e9GB", "99999days"])
def test_what_is_no_limit_is_refused(wrong):
    """Recordings would be removed at once, or never."""
    with pytest.raises(UserError, match="neither a time nor a size"):
        parse_limit(wrong, name="--keep")
