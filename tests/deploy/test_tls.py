"""The keys of deploy/make-keys.sh in the TLS configurations of deploy/zenoh, over real sessions."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from hvt_common.link.keys import EdgeKeys, Row, selector
from hvt_common.link.session import declare_publisher, open_session
from hvt_common.link.zenoh_config import LinkSettings

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
MAKE_KEYS = DEPLOY / "make-keys.sh"

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed"),
]


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a CA and the keys of a ground on loopback and of an edge, from the script users run."""
    folder = tmp_path_factory.mktemp("tls")
    subprocess.run([MAKE_KEYS, folder, "ground", "127.0.0.1", "localhost"], check=True, capture_output=True)
    subprocess.run([MAKE_KEYS, folder, "edge"], check=True, capture_output=True)
    return folder


def _settled(name: str, keys: Path, folder: Path) -> Path:
    """A file of deploy/zenoh with the folder of the keys put in."""
    file = folder / name
    text = (DEPLOY / "zenoh" / name).read_text(encoding="utf-8")
    assert "/etc/hvt/tls/" in text
    file.write_text(text.replace("/etc/hvt/tls/", f"{keys}/"), encoding="utf-8")
    return file


def test_private_keys_are_private(keys: Path) -> None:
    """A key that other users of the machine can read is no key."""
    made = {file.name for file in keys.iterdir()}
    assert {"ca.key", "ca.pem", "ground.key", "ground.pem", "edge.key", "edge.pem"} <= made
    assert {file.stat().st_mode & 0o077 for file in keys.glob("*.key")} == {0}


def test_the_certificate_of_a_listener_names_its_addresses(keys: Path) -> None:
    """Zenoh compares the name in the endpoint with the certificate: without it no edge connects."""
    command = ["openssl", "x509", "-in", str(keys / "ground.pem"), "-noout", "-ext", "subjectAltName"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "DNS:ground, IP Address:127.0.0.1, DNS:localhost" in text


def test_make_keys_says_how_it_is_used() -> None:
    """Called without arguments it must not make keys anywhere."""
    done = subprocess.run([MAKE_KEYS], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "make-keys.sh DIR NAME" in done.stderr


def test_an_edge_with_a_key_gets_through(keys: Path, tmp_path: Path, free_port: int) -> None:
    """The documented way onto a network: if it fails, people fall back to --insecure."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    ground = LinkSettings(
        role="ground", listen=(endpoint,), zenoh_config=_settled("ground-tls.json5", keys, tmp_path)
    )
    edge = LinkSettings(
        role="edge", connect=(endpoint,), zenoh_config=_settled("edge-tls.json5", keys, tmp_path)
    )
    with open_session(ground) as receiving, open_session(edge) as sending:
        samples = receiving.declare_subscriber(selector(Row.BASE))
        publisher = declare_publisher(sending, Row.BASE, keys=EdgeKeys("uav-1"))
        deadline_s = time.monotonic() + 20
        while not publisher.matching_status.matching:
            assert time.monotonic() < deadline_s, "the edge did not get in"
            time.sleep(0.01)
        assert len(list(receiving.info.peers_zid())) == 1
        publisher.put(b"over tls")
        assert samples.recv().payload.to_bytes() == b"over tls"


def test_an_edge_without_a_key_stays_out(keys: Path, tmp_path: Path, free_port: int) -> None:
    """Knowing the CA must not be enough: anybody can read a certificate off the wire."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    ground = LinkSettings(
        role="ground", listen=(endpoint,), zenoh_config=_settled("ground-tls.json5", keys, tmp_path)
    )
    stranger_file = tmp_path / "stranger.json5"
    tls = {"root_ca_certificate": str(keys / "ca.pem")}
    stranger_file.write_text(json.dumps({"transport": {"link": {"tls": tls}}}), encoding="utf-8")
    stranger = LinkSettings(role="edge", connect=(endpoint,), zenoh_config=stranger_file)
    with open_session(ground) as receiving, open_session(stranger) as calling:
        time.sleep(1.5)  # several attempts: a connecting side tries every 0.2 to 1 s
        assert list(receiving.info.peers_zid()) == []
        assert list(calling.info.peers_zid()) == []


def test_a_ground_with_keys_may_listen_beyond_this_machine(
    keys: Path, tmp_path: Path, free_port: int
) -> None:
    """With keys --insecure must not be needed, or everybody would set it."""
    ground = LinkSettings(
        role="ground",
        listen=(f"tls/0.0.0.0:{free_port}",),
        zenoh_config=_settled("ground-tls.json5", keys, tmp_path),
    )
    with open_session(ground):
        pass
