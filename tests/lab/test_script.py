"""Scenario files: what they mean, and what is said of one that cannot be used."""

import subprocess
import sys
from pathlib import Path

import pytest

import bench.fleet.__main__
import lab.scale
from hvt_common.errors import UserError
from lab.link.script import LENGTHS, load_scenario, scenario_names

FILE = """
about = "x"
budget = "800kbps"
[link]
rate = "1Mbps"
[short]
lasts = "10s"
[full]
lasts = "20s"
"""

NAMES = {
    *("steady-1M", "steady-300k", "step-1M-200k-1M", "drone-fade", "burst-loss", "burst-loss-udp"),
    *("outage-8s", "outage-60s", "satellite-600ms", "flapping"),
}


def scenario(tmp_path, text):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    return load_scenario(file)


def test_the_scenarios_of_the_bars_are_there():
    """`make link` would leave one out, and nobody notice."""
    assert set(scenario_names()) == NAMES
    for name in NAMES:
        found = load_scenario(name)
        assert found.bars
        assert found.script("short").lasts_s < found.script("full").lasts_s


@pytest.mark.parametrize(("name", "spans"), [("outage-8s", [(12, 20)]), ("outage-60s", [(15, 75)])])
def test_an_outage_lasts_as_long_as_its_name_says(name, spans):
    """The bar would be held on an easier outage."""
    assert list(load_scenario(name).script("full").dark) == spans


def test_a_step_is_told_as_a_fall_and_a_rise():
    """The times after a change would be measured from the wrong moment."""
    script = load_scenario("step-1M-200k-1M").script("full")
    assert (script.falls_s, script.rises_s) == ((15,), (35,))
    rates = [script.at(t).rate_bps for t in (-5, 14.9, 15, 34.9, 35, 99)]
    assert rates == [10**6, 10**6, 2 * 10**5, 2 * 10**5, 10**6, 10**6]


def test_a_fade_swings_and_goes_dark_at_its_lowest():
    """A fade without its hole is a mild link; the hour of it would need a file of its own."""
    script = load_scenario("drone-fade").script("full")
    rates = [phase.state.rate_bps for phase in script.phases]
    assert (min(rates), max(rates)) == pytest.approx((200_000, 1_200_000), rel=0.02)
    assert all(script.at(begin).rate_bps < 210_000 for begin, _ in script.dark)
    assert len(script.dark) == 4
    soak = load_scenario("drone-fade").script("full", lasts="60min")
    assert (soak.lasts_s, len(soak.dark)) == (3600, 180)


def test_bursts_have_the_share_and_come_from_the_seed():
    """Five percent would be three or eight, or another run's."""
    found = load_scenario("burst-loss")
    script = found.script("full", seed=1)
    lost_s = sum(script.until(one.start_s) - one.start_s for one in script.phases if one.state.loss == 1.0)
    assert lost_s / script.lasts_s == pytest.approx(0.05, rel=0.15)
    assert found.script("full", seed=1) == script != found.script("full", seed=2)


def test_bits_leave_only_in_light():
    """What is sent into darkness would arrive in it."""
    script = load_scenario("outage-8s").script("full")
    assert script.finish_s(10.0, 1_000_000) == pytest.approx(11.0)
    assert script.finish_s(11.5, 1_000_000) == pytest.approx(20.5)
    assert script.carries_bits(0, 40) == pytest.approx(32e6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (('rate = "1Mbps"', ""), "rate is missing"),
        (('rate = "1Mbps"', 'rate = "fast"'), "link: rate 'fast' is not a bitrate"),
        (('rate = "1Mbps"', 'rate = "1Mbps"\nspeed = 3'), "'speed' is not a setting; there are burst, delay"),
        (('rate = "1Mbps"', 'rate = "1Mbps"\nloss = "95%"'), "loss '95%' is too much"),
        (('rate = "1Mbps"', 'rate = "1Mbps"\nqueue = "1kB"'), "queue '1kB' is not usable"),
        (('rate = "1Mbps"', 'rate = "1Mbps"\nqueue = "32²kB"'), "queue '32²kB' is not usable"),
        (('rate = "1Mbps"', 'rate = "1Mbps"\ndelay = "9s"'), "delay '9s' is too much"),
        (("[link]", 'transport = "sctp"\n[link]'), "transport 'sctp' is not usable: tcp, udp or quic"),
        (('lasts = "10s"', 'lasts = "0s"'), "lasts 0 s is not usable"),
        (
            ('lasts = "10s"', 'lasts = "10s"\ndark = [{ at = "8s", lasts = "3s" }]'),
            "dark 1: must begin after",
        ),
        (('lasts = "10s"', 'lasts = "10s"\nsteps = [{ at = "12s" }]'), "step 1: at '12s' is not usable"),
        (('lasts = "10s"', 'lasts = "10s"\nsteps = 3'), "steps must be a list of tables"),
        (
            ('lasts = "10s"', 'lasts = "10s"\nwave = { low = "2M", high = "1M", period = "9s" }'),
            "low must be below",
        ),
        (("[short]", '[bars]\n"x" = "about 3"\n[short]'), "write '<= 2'"),
        (("[full]", "[fill]"), "'fill' is not a setting"),
        (('budget = "800kbps"', ""), "budget is missing"),
        (("[full]", '[bars]\n"x" = ""\n[full]'), "bar 'x' is ''"),
        (("[link]", "[link"), "not a scenario"),
        (("[link]", f"x = {'[' * 5000}\n[link]"), "not a scenario"),
        (("[link]", f"{'a.' * 5000}a = 1\n[link]"), "has more than 32 parts"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, change, sentence):
    """A typing error in a scenario would be a traceback, or a link that is not what one thinks."""
    scenario(tmp_path, FILE)
    with pytest.raises(UserError, match="mine") as refused:
        scenario(tmp_path, FILE.replace(*change))
    assert sentence in str(refused.value)


def test_an_unknown_scenario_is_answered_with_the_known():
    """`make link SCENARIO=steady` would say nothing useful."""
    with pytest.raises(
        UserError, match="'steady' is unknown: there are burst-loss, burst-loss-udp, drone-fade"
    ):
        load_scenario("steady")
    assert LENGTHS == ("short", "full")


@pytest.mark.parametrize("main", [lab.scale.main, bench.fleet.__main__.main])
@pytest.mark.parametrize(("word", "code"), [("--help", 0), ("many", 2)])
def test_a_measurement_says_what_it_takes(main, word, code):
    """Who asks for its help would read a traceback."""
    with pytest.raises(SystemExit) as ended:
        main([word])
    assert ended.value.code == code


@pytest.mark.nightly
@pytest.mark.integration
def test_no_walk_is_longer_than_its_bound():
    """Who follows a frame or a still by reading would get lost."""
    command = [sys.executable, "-m", "lab.walks"]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
