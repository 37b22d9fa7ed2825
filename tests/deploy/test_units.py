"""The systemd units, as systemd and our own parsers read them."""

import configparser
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

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


def _read(unit: Path) -> configparser.SectionProxy:
    """Its section ``Service``."""
    parsed = _Unit(delimiters=("=",), comment_prefixes=("#",), interpolation=None)
    parsed.read_string(unit.read_text(encoding="utf-8").replace("%i", INSTANCE))
    return parsed["Service"]


@pytest.mark.parametrize(
    ("unit", "program", "kind", "sample"),
    [
        ("hvt-edge@.service", "hvt-edge", EdgeConfig, f"edge-{INSTANCE}.toml"),
        ("hvt-ground.service", "hvt-ground", config_class(), "ground.toml"),
    ],
)
def test_a_unit_starts_with_the_sample_configuration(unit: str, program: str, kind: Any, sample: str) -> None:
    """A unit with a flag that the program does not know would end with code 2 and never be tried again."""
    command, *arguments = shlex.split(_read(DEPLOY / "systemd" / unit)["ExecStart"])
    at = arguments.index("--config") + 1
    assert (command, arguments[at]) == (BIN + program, f"/etc/hvt/{sample}")
    arguments[at] = str(DEPLOY / "config" / sample.replace(f"-{INSTANCE}", ""))
    config, _ = load(kind, arguments, program=program, description="")
    if kind is EdgeConfig:
        assert EdgeKeys(check_edge(config).edge_id).edge == INSTANCE
    else:
        assert check_ground(config).record == Path()


def test_router_unit_runs_the_script_that_is_in_the_checkout() -> None:
    """The router is a script, not an installed command: a moved file would leave the unit pointing at nothing."""
    assert {unit.name for unit in UNITS} == {"hvt-edge@.service", "hvt-ground.service", "hvt-router.service"}
    python, script, *words = shlex.split(_read(DEPLOY / "systemd" / "hvt-router.service")["ExecStart"])
    assert (python, *words) == (BIN + "python", "--zenoh-config", "/etc/hvt/router.json5")
    assert (DEPLOY.parent / Path(script).relative_to("/opt/hvt/src")).is_file()


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_unit_begins_ends_and_writes_as_its_program_does(unit: Path) -> None:
    """Another signal would cost the summary; retrying code 2 would fill the system log with one sentence for ever.

    systemd's limit of 90 s would kill a small board that loads its networks; without AF_UNIX nobody is told that it
    is ready; and ProtectSystem makes all but its own folder read-only.
    """
    service = _read(unit)
    user = (DEPLOY / "systemd" / "hvt-sysusers.conf").read_text().splitlines()[-1].split()[1]
    found = [
        service[one] for one in ("KillSignal", "Restart", "RestartPreventExitStatus", "ProtectSystem", "User")
    ]
    assert found == ["SIGINT", "on-failure", "2", "strict", user]
    assert float(service["TimeoutStopSec"]) > 3, "a clean end may take 3 s"
    if unit.stem != "hvt-router":
        assert (service["Type"], service["TimeoutStartSec"]) == ("notify", "infinity")
        assert float(service["WatchdogSec"]) >= 30, "a frame each ten seconds is no loop that hangs"
        assert "AF_UNIX" in service["RestrictAddressFamilies"]
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


@pytest.mark.parametrize(
    ("name", "kind", "named"),
    [
        ("edge", EdgeConfig, {"record_base", "labels", "zenoh_config"}),
        ("ground", config_class(), {"connect", "classifier", "labels"}),
    ],
)
def test_a_sample_fits_a_300_kbps_radio_and_listens_here_alone(
    tmp_path: Path, name: str, kind: Any, named: set[str]
) -> None:
    """The first thing an engineer copies: it must load, leave the radio room, and open no machine to its network."""
    check: Any = check_edge if name == "edge" else check_ground
    sample = DEPLOY / "config" / f"{name}.toml"
    config, given = load(kind, ["--config", str(sample)], program=name, description="")
    if name == "edge":
        config = check(with_profile(config, given=given.values))
        assert (config.budget_bps, config.measures) == (250_000, True)
        assert configure(LinkSettings(role="edge", connect=config.connect))[1] == ()
    else:
        config = check(config)
        assert configure(LinkSettings(role="ground", listen=config.listen))[1] == ("tcp/127.0.0.1:7447",)
        assert not config.insecure
    words = ["--config", str(_uncommented(sample, tmp_path))]
    everything, asked = load(kind, words, program=name, description="")
    check(everything)
    assert named <= set(asked.values)


@pytest.mark.parametrize(
    "file", sorted((DEPLOY / "zenoh").glob("*.json5")), ids=lambda file: file.stem.replace("-", "_")
)
def test_zenoh_reads_the_file(file: Path) -> None:
    """A misspelt key is an error in Zenoh: the process would not start."""
    connect = () if "listen" in json5.loads(file.read_text(encoding="utf-8")) else ("tcp/127.0.0.1:7447",)
    config, _ = configure(LinkSettings(role="ground", connect=connect, zenoh_config=file))
    assert config.get_json("transport/shared_memory/enabled") == "false"
    assert config.get_json("scouting/multicast/enabled") == "false"
