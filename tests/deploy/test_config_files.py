"""The sample configurations, read by what will read them."""

from __future__ import annotations

import re
from pathlib import Path

import json5
import pytest

from hvt_common.config import load
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_edge.config import EdgeConfig, with_profile
from hvt_edge.config import check as check_edge
from hvt_ground.config import check as check_ground
from hvt_ground.extras import config_class

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"


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
