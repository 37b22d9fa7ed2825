"""``hvt-ground doctor``: before the first edge comes."""

from __future__ import annotations

import json
import socket

from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_ground.cli import main
from programs.processes import free_ports


def examined(capsys, *words: str) -> tuple[int, dict[str, dict[str, str]]]:
    """Exit code, and the findings by name."""
    code = main(["doctor", "--json", *words])
    return code, {row["check"]: row for row in json.loads(capsys.readouterr().out)}


def test_it_names_the_edges_that_are_there(tmp_path, capsys):
    """A ground that hears nobody would be searched for a fault of its own."""
    port, page = free_ports(2)
    words = ("--connect", f"tcp/127.0.0.1:{port}", "--record", str(tmp_path / "flights"))
    words += ("--classifier", "none", "--detector", "motion", "--web", f"127.0.0.1:{page}")
    settings = LinkSettings("edge", listen=(f"tcp/127.0.0.1:{port}",))
    with open_session(settings) as edge, edge.liveliness().declare_token("hvt/uav-7/alive"):
        code, found = examined(capsys, *words)
    assert found["link"] == {"check": "link", "state": "ok", "found": "edges: uav-7", "todo": ""}
    assert "GB are free" in found["recordings"]["found"]
    assert not (tmp_path / "flights").exists(), "it changes nothing"
    assert (code, found["page"]["state"]) == (0, "ok")


def test_each_fault_is_told_with_what_to_do(tmp_path, capsys):
    """One after the other, each after a start of its own."""
    (tmp_path / "file").write_bytes(b"")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        code, found = examined(
            capsys,
            *("--detector", str(tmp_path / "gone.onnx"), "--record", str(tmp_path / "file" / "flights")),
            *("--web", f"127.0.0.1:{taken.getsockname()[1]}"),
            *("--listen", f"tcp/127.0.0.1:{free_ports(1)[0]}"),
        )
    assert code == 2
    for name in ("models", "recordings", "page"):
        assert found[name]["state"] == "wrong", found[name]
        assert found[name]["todo"], found[name]
    assert found["link"]["state"] == "warning", "edges may come later"


def test_what_extras_send_and_write_is_checked(tmp_path, capsys, monkeypatch):
    """A certificate or a folder that is missing would be found at the airfield."""
    monkeypatch.delenv("PYTAK_TLS_CLIENT_CERT", raising=False)
    link = ("--detector", "motion", "--classifier", "none", "--record", str(tmp_path))
    link += ("--connect", f"tcp/127.0.0.1:{free_ports(1)[0]}")
    (tmp_path / "notes.txt").touch()
    told = ("--cot", "udp://239.2.3.1:6969", "--stills", str(tmp_path / "notes.txt"))
    _, found = examined(capsys, *link, *told)
    assert (found["reports"]["state"], found["recordings"]["state"]) == ("ok", "wrong")
    assert "notes.txt is no folder" in found["recordings"]["found"]
    log = tmp_path / "gone" / "flight.hvtlog"
    code, found = examined(capsys, *link, "--cot", "tls://127.0.0.1:8089", "--log", str(log))
    assert found["recordings"]["found"] == f"--log {log} is in a folder that does not exist"
    assert (code, found["reports"]["state"]) == (2, "wrong")
    assert "PYTAK_TLS_CLIENT_CERT" in found["reports"]["found"] + found["reports"]["todo"]
