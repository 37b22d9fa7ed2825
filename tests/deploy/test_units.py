"""The systemd units, as systemd and our own parsers read them."""

from __future__ import annotations

import configparser
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import json5
import pytest

from hvt_common.config import load
from hvt_common.protocol.channels import EdgeKeys
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_edge.config import EdgeConfig, with_profile
from hvt_edge.config import check as check_edge
from hvt_ground.config import check as check_ground
from hvt_ground.extras import config_class

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
INSTANCE = "uav-1"
BIN = "/opt/hvt/venv/bin/"


class _Unit(configparser.RawConfigParser):
    def optionxform(self, optionstr: str) -> str:
        return optionstr


def _read(unit: Path) -> _Unit:
    parsed = _Unit(delimiters=("=",), comment_prefixes=("#",), interpolation=None)
    parsed.read_string(unit.read_text(encoding="utf-8").replace("%i", INSTANCE))
    return parsed


def _command(unit: Path) -> list[str]:
    return shlex.split(_read(unit)["Service"]["ExecStart"])


def test_units_are_there() -> None:
    """Without this, an empty folder would pass every other test of this file."""
    assert {unit.name for unit in UNITS} == {"hvt-edge@.service", "hvt-ground.service", "hvt-router.service"}


def test_edge_unit_starts_with_the_sample_configuration() -> None:
    """A unit with a flag that hvt-edge does not know would end with code 2 and never be tried again."""
    program, *arguments = _command(DEPLOY / "systemd" / "hvt-edge@.service")
    assert program == BIN + "hvt-edge"
    at = arguments.index("--config") + 1
    assert arguments[at] == f"/etc/hvt/edge-{INSTANCE}.toml"
    arguments[at] = str(DEPLOY / "config" / "edge.toml")
    config, _ = load(EdgeConfig, arguments, program="hvt-edge", description="")
    assert check_edge(config).edge_id == INSTANCE
    assert EdgeKeys(config.edge_id).edge == INSTANCE


def test_ground_unit_starts_with_the_sample_configuration() -> None:
    """The same for the ground."""
    program, *arguments = _command(DEPLOY / "systemd" / "hvt-ground.service")
    assert program == BIN + "hvt-ground"
    at = arguments.index("--config") + 1
    assert arguments[at] == "/etc/hvt/ground.toml"
    arguments[at] = str(DEPLOY / "config" / "ground.toml")
    config, _ = load(config_class(), arguments, program="hvt-ground", description="")
    assert check_ground(config).record == Path()


def test_router_unit_runs_the_script_that_is_in_the_checkout() -> None:
    """The router is a script, not an installed command: a moved file would leave the unit pointing at nothing."""
    python, script, flag, file = _command(DEPLOY / "systemd" / "hvt-router.service")
    assert python == BIN + "python"
    assert (DEPLOY.parent / Path(script).relative_to("/opt/hvt/src")).is_file()
    assert (flag, file) == ("--zenoh-config", "/etc/hvt/router.json5")


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_unit_stops_like_ctrl_c_and_does_not_retry_a_wrong_configuration(unit: Path) -> None:
    """Another signal would cost the summary; retrying code 2 would fill the system log with one sentence for ever."""
    service = _read(unit)["Service"]
    assert service["KillSignal"] == "SIGINT"
    assert service["Restart"] == "on-failure"
    assert service["RestartPreventExitStatus"] == "2"
    assert float(service["TimeoutStopSec"]) > 3, "a clean end may take 3 s"
    assert (
        service["User"] == (DEPLOY / "systemd" / "hvt-sysusers.conf").read_text().splitlines()[-1].split()[1]
    )


@pytest.mark.parametrize("name", ["hvt-edge@.service", "hvt-ground.service"])
def test_unit_may_take_its_time_to_be_ready(name: str) -> None:
    """Without it, systemd's limit of 90 s would kill a small board that loads its networks, again and again."""
    service = _read(DEPLOY / "systemd" / name)["Service"]
    assert (service["Type"], service["TimeoutStartSec"]) == ("notify", "infinity")
    assert float(service["WatchdogSec"]) >= 30, "a frame each ten seconds is no loop that hangs"
    assert "AF_UNIX" in service["RestrictAddressFamilies"], (
        "without it nobody is told, and the start never ends"
    )


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_unit_writes_where_it_may(unit: Path) -> None:
    """ProtectSystem=strict makes all else read-only: a working directory outside loses the recording."""
    service = _read(unit)["Service"]
    assert service["ProtectSystem"] == "strict"
    if "StateDirectory" in service:
        assert service["WorkingDirectory"] == "%S/" + service["StateDirectory"]


@pytest.fixture
def installed(tmp_path: Path) -> list[str]:
    """The units with the paths of an installation replaced by those of this one, so that systemd finds programs."""
    bin_here = Path(sys.executable).parent
    if not (bin_here / "hvt-edge").exists():
        pytest.skip("hvt is not installed beside this interpreter: no console scripts to point the units at")
    copies = []
    for unit in UNITS:
        text = unit.read_text(encoding="utf-8").replace(BIN, f"{bin_here}/")
        copy = tmp_path / unit.name
        copy.write_text(text.replace("/opt/hvt/src", str(DEPLOY.parent)), encoding="utf-8")
        copies.append(str(copy))
    return copies


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_accepts_the_units(installed: list[str]) -> None:
    """A misspelt hardening option is ignored by systemd with a line in its log: the service runs without it."""
    found = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *installed], capture_output=True, text=True, check=False
    )
    names = [Path(copy).name for copy in installed]
    complaints = [line for line in found.stderr.splitlines() if any(name in line for name in names)]
    assert complaints == []
    assert found.returncode == 0, found.stderr


# The sample configurations, read by what will read them.


def _uncommented(sample: Path, folder: Path) -> Path:
    """The sample with its commented-out settings switched on, each key as it stands last."""
    lines: dict[str, str] = {}
    for line in sample.read_text(encoding="utf-8").splitlines():
        if found := re.match(r"(?:# )?([a-z-]+) = (?:\[.*\]|\".*\"|[\w.]+)$", line):
            lines[found[1]] = line.removeprefix("# ")
    file = folder / sample.name
    file.write_text("\n".join(lines.values()), encoding="utf-8")
    return file


def test_sample_of_the_edge_is_for_a_300_kbps_radio(tmp_path: Path) -> None:
    """The first thing an engineer copies: it must load, and leave the radio room."""
    sample = DEPLOY / "config" / "edge.toml"
    config, given = load(EdgeConfig, ["--config", str(sample)], program="hvt-edge", description="")
    config = check_edge(with_profile(config, given=given.values))
    assert config.budget_bps == 250_000
    assert config.measures
    assert configure(LinkSettings(role="edge", connect=config.connect))[1] == ()
    everything, asked = load(
        EdgeConfig, ["--config", str(_uncommented(sample, tmp_path))], program="hvt-edge", description=""
    )
    check_edge(everything)
    assert {"record_base", "labels", "zenoh_config"} <= set(asked.values)


def test_sample_of_the_ground_listens_on_this_machine_only(tmp_path: Path) -> None:
    """Copied as it is, it must not open the machine to its network."""
    sample = DEPLOY / "config" / "ground.toml"
    config, _ = load(config_class(), ["--config", str(sample)], program="hvt-ground", description="")
    config = check_ground(config)
    settings = LinkSettings(role="ground", listen=config.listen, insecure=config.insecure)
    assert configure(settings)[1] == ("tcp/127.0.0.1:7447",)
    assert not config.insecure
    everything, asked = load(
        config_class(),
        ["--config", str(_uncommented(sample, tmp_path))],
        program="hvt-ground",
        description="",
    )
    check_ground(everything)
    assert {"connect", "classifier", "labels"} <= set(asked.values)


@pytest.mark.parametrize(
    "file", sorted((DEPLOY / "zenoh").glob("*.json5")), ids=lambda file: file.stem.replace("-", "_")
)
def test_zenoh_reads_the_file(file: Path) -> None:
    """A misspelt key is an error in Zenoh: the process would not start."""
    connect = () if "listen" in json5.loads(file.read_text(encoding="utf-8")) else ("tcp/127.0.0.1:7447",)
    config, _ = configure(LinkSettings(role="ground", connect=connect, zenoh_config=file))
    assert config.get_json("transport/shared_memory/enabled") == "false"
    assert config.get_json("scouting/multicast/enabled") == "false"
