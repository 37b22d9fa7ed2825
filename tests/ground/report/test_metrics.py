"""A ground that is watched: what Prometheus, a probe and a second shell read while it serves a real edge."""

import contextlib
import json
import socket
import subprocess
import sys
import urllib.error
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from hvt_common.protocol.messages import WIRE_VERSION
from programs.processes import Link, eventually, free_ports

pytestmark = pytest.mark.integration

EDGE = ("--fps", "5", "--size", "640x360", "--detector", "motion", "--method", "M0")


def read(address: str, path: str) -> bytes:
    """What a path answers."""
    with urllib.request.urlopen(f"http://{address}{path}", timeout=60) as answer:
        return answer.read()


def series(address: str) -> dict[tuple[str, str], float]:
    """Values by name and edge."""
    families = text_string_to_metric_families(read(address, "/metrics").decode())
    return {
        (one.name, one.labels.get("edge", "")): one.value
        for family in families
        for one in family.samples
        if "link" not in one.labels or one.value
    }


def status(*arguments: str) -> subprocess.CompletedProcess[str]:
    """``hvt-ground status``."""
    command = [sys.executable, "-m", "hvt_ground.cli", "status", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.nightly
def test_a_ground_in_service_can_be_watched(tmp_path, long_scene):
    """A team would learn of a lost link from the one who looks at the screen."""
    address = f"127.0.0.1:{free_ports(1)[0]}"
    with Link(tmp_path) as link:
        ground = link.ground("--metrics", address, "--detector", "motion", "--classifier", "none")
        pose = ("--pose", "fixed:48.1,11.5,120,90,-45", "--fov", "60")
        edge = link.edge("--source", str(long_scene), *EDGE, "--edge-id", "uav-1", *pose)
        received = ("hvt_frames_received_total", "uav-1")

        def flies() -> bool:
            try:
                return series(address).get(received, 0) > 5
            except OSError:
                return False  # it is starting

        eventually(flies, what="the metrics show frames")
        eventually(
            lambda: ("hvt_pose_age_seconds", "uav-1") in series(address),
            what="it says where it is",
        )
        found = series(address)
        assert found["hvt_pose_latitude_degrees", "uav-1"] == pytest.approx(48.1)
        assert found["hvt_pose_age_seconds", "uav-1"] < 30
        assert found["hvt_budget_bits_per_second", "uav-1"] == 800_000
        assert found["hvt_received_bits_per_second", "uav-1"] > 0
        assert found["hvt_link", "uav-1"] == 1
        assert read(address, "/healthz") == read(address, "/readyz") == b"ok\n"
        said = status("--at", address)
        assert said.returncode == 0, said.stderr
        assert "uav-1" in said.stdout
        assert "uav-1 is at 48.10000, 11.50000" in said.stdout
        state = json.loads(status("--at", address, "--json").stdout)
        session = state["edges"][0]["session"]
        assert session["frames_received"] > 5
        assert 0 < session["budget_share"] <= 1
        assert (session["stills_pending"], session["tracks_doubted"]) == (0, 0), "video alone"
        assert session["pose"]["height_m"] == pytest.approx(120, abs=0.1)
        assert state["schema_version"] == WIRE_VERSION
        with pytest.raises(urllib.error.HTTPError, match="404"):
            read(address, "/../../etc/passwd")
        host, _, port = address.partition(":")
        with contextlib.ExitStack() as stack:
            for number in range(40):
                one = stack.enter_context(socket.create_connection((host, int(port))))
                with contextlib.suppress(OSError):  # it may be closed at once
                    one.sendall(b"\x00\xff" * 4000 if number % 2 else b"GET /me")
            count = found[received]

            def serves() -> bool:
                try:
                    return series(address)[received] > count
                except OSError:
                    return False  # all places are taken, for some seconds

            eventually(serves, what="it serves on")
        busy = link.start("hvt_ground.cli", ["--metrics", address], name="busy")
        busy.until(f"--metrics {address} cannot be listened on")
        busy.kill()
        edge.kill()
        eventually(
            lambda: (
                ("hvt_link", "uav-1") in series(address)
                and json.loads(read(address, "/state.json"))["edges"][0]["link"] == "lost"
            ),
            what="the link is lost",
        )
        lost = series(address)
        assert ("hvt_received_bits_per_second", "uav-1") not in lost, "nothing is known of it"
        ground.stop()


def test_where_no_ground_answers_is_a_sentence():
    """A traceback would say that the command is broken."""
    said = status("--at", f"127.0.0.1:{free_ports(1)[0]}")
    assert said.returncode == 1, said.stdout + said.stderr
    assert "no ground answers at" in said.stderr
    assert len(said.stderr.strip().splitlines()) == 1
