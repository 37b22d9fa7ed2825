"""What the program says of an address that it cannot use, however it was mistyped."""

import cv2
import numpy as np
import pytest

from hvt_common.runtime.failures import Awaited
from hvt_edge.cli import main

SECRET = "S3CRETpw"
ADDRESSES = [
    "rtsp://admin:{secret}@127.0.0.1:{port}/cam",
    "rtsp://admin:{secret}#1@127.0.0.1:{port}/cam",
    "rtsp://admin:a/{secret}@127.0.0.1:{port}/cam",
    "rtsp://admin:a?{secret}@127.0.0.1:{port}/cam",
    "rtsp://admin:a[{secret}@127.0.0.1:{port}/cam",
    "rtsp://admin:{secret} x@127.0.0.1:{port}/cam",
    "rtsp://127.0.0.1:{port}/cam?password={secret}",
    "rtsp://127.0.0.1:{port}/user=admin&password={secret}&channel=1",
    "http://127.0.0.1:{port}/{secret}/video",
    "srt://127.0.0.1:{port}?passphrase={secret}",
    "rstp://admin:{secret}@127.0.0.1/cam",
    "rtsp:/admin:{secret}@127.0.0.1/cam",
    "rtsp//admin:{secret}@127.0.0.1/cam",
    "admin:{secret}@127.0.0.1/cam",
    "file.mp4?password={secret}",
]
FORMS = {
    "source": lambda address: ["--source", address],
    "joined": lambda address: [f"--source={address}"],
    "mistyped option": lambda address: [f"--sorce={address}"],
    "no option": lambda address: [address],
    "a number": lambda address: ["--source", "demo", "--fps", address],
    "passthrough": lambda address: ["--source", address, "--encoder", "passthrough"],
    "printed": lambda address: ["--source", address, "--print-config"],
    "pose": lambda address: ["--source", "{pictures}", "--pose", address],
}


@pytest.fixture(autouse=True)
def stopped_at_once(monkeypatch):
    """A camera that is not there is waited for until somebody stops the program: here at once."""
    monkeypatch.setattr(Awaited, "wait", lambda awaited, _stop: awaited.part)


@pytest.mark.parametrize("address", ADDRESSES)
@pytest.mark.parametrize("form", FORMS)
def test_no_sentence_has_the_password(free_port, tmp_path, capsys, address, form):
    """Who shows an error message to others would give the camera away."""
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((360, 640, 3), np.uint8))
    wrong = address.format(secret=SECRET, port=free_port)
    main([word.replace("{pictures}", str(tmp_path)) for word in FORMS[form](wrong)])
    said = "".join(capsys.readouterr())
    assert said
    assert SECRET not in said


@pytest.mark.parametrize("address", ADDRESSES)
def test_nor_where_a_file_has_the_address(tmp_path, capsys, free_port, address):
    """The settings of a service would be in its log."""
    file = tmp_path / "edge.toml"
    for text in ("source = '{}'", "fps = '{}'", "sorce = '{}'", "source = {}"):
        file.write_text(text.format(address.format(secret=SECRET, port=free_port)))
        main(["--config", str(file)])
        assert SECRET not in "".join(capsys.readouterr())
