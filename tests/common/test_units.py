"""Quantities as people write them."""

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

BITRATES = {
    "800kbps": 800_000,
    "0.8Mbps": 800_000,
    "0.8 Mbit/s": 800_000,
    "800000": 800_000,
    "800k": 800_000,
    ".8M": 800_000,
    "1m": 1_000_000,
    "1.": 1,
    "64 bps": 64,
    "1000Mbps": 1_000_000_000,
}
DURATIONS = {"2s": 2.0, "500ms": 0.5, "1min": 60.0, "1m": 60.0, "2h": 7200.0, "0": 0.0, "1.5": 1.5}
LIMITS = {
    "1h": Limit(seconds=3600.0),
    "14 days": Limit(seconds=1_209_600.0),
    "2weeks": Limit(seconds=1_209_600.0),
    "500MB": Limit(size_bytes=500_000_000),
    "1.5tb": Limit(size_bytes=1_500_000_000_000),
}


@pytest.mark.parametrize(
    ("parse", "known"),
    [
        (parse_bitrate, BITRATES),
        (parse_duration_s, DURATIONS),
        (parse_size, {"1280x720": (1280, 720), " 640 X 360 ": (640, 360)}),
        (parse_share, {"0.8125": 0.8125, "81.25%": 0.8125, "1": 1.0}),
        (parse_limit, LIMITS | {str(limit): limit for limit in LIMITS.values()}),
    ],
)
def test_what_people_write_is_read(parse, known):
    """A budget, a pause or a limit would be another than the one that was meant."""
    assert {text: parse(text, name="--it") for text in known} == known


@pytest.mark.parametrize(
    ("parse", "says", "wrong"),
    [
        (
            *(parse_bitrate, "^--it .* is not a bitrate: write 800kbps"),
            ["", "fast", "-1", "0", "0.4", "1Gbps", "2000M", "1e6", "8 00k", "1,5M", "kbps", "nan"],
        ),
        (
            *(parse_duration_s, "^--it .* is not a duration: write 2s"),
            ["", "-1s", "2 parsecs", "1e3", "inf", "9" * 400, "20000000s", "s"],
        ),
        (
            *(parse_size, "^--it .* is not a size: write WIDTHxHEIGHT"),
            ["", "1280", "x720", "1280x", "-1x2", "9999999999x1", "1280*720", "1280x720x3"],
        ),
        (parse_share, "^--it .* is not a share", ["", "%", "2", "-0.1", "101%", "50%%", "nan", "half"]),
        (
            *(parse_limit, "neither a time nor a size"),
            ["", "0", "14", "0.5s", "999kB", "3parsecs", "-1h", "1e9GB", "99999days"],
        ),
    ],
)
def test_what_is_no_quantity_is_one_sentence(parse, says, wrong):
    """The user would see a traceback, or a flight with a budget of nothing."""
    for text in wrong:
        with pytest.raises(UserError, match=says):
            parse(text, name="--it")


def test_bitrates_are_shown_with_three_digits():
    """A table would say 1.4e6, or too little."""
    shown = {800_000: "800 kbps", 1_400_000: "1.40 Mbps", 12_345: "12 kbps", 0: "0 kbps", 999_499: "999 kbps"}
    assert {bps: bitrate_text(bps) for bps in shown} == shown
