"""Files that people name are read whole, or refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_common.files import read_text
from hvt_common.inference.labels import read_labels
from hvt_common.transport.zenoh_config import LinkSettings, key_pair
from hvt_edge.config import EdgeConfig
from hvt_study.datasets.label_files import read_text as read_annotations

ENDLESS = Path("/dev/zero")


@pytest.mark.skipif(not ENDLESS.exists(), reason="there is no file without an end")
@pytest.mark.parametrize(
    "read",
    [
        read_text,
        lambda path: load(EdgeConfig, ["--config", str(path)], program="hvt-edge", description=""),
        lambda path: key_pair(LinkSettings(role="edge", zenoh_config=path)),
        read_labels,
    ],
    ids=["text", "config", "zenoh-config", "labels"],
)
def test_a_file_without_an_end_is_refused(read):
    """The process grew until its system ended it."""
    with pytest.raises((OSError, UserError)) as raised:
        read(ENDLESS)
    assert "larger than 16 MB" in str(raised.value) or "not a file" in str(raised.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_is_read_as_its_byte_order_mark_says(encoding, tmp_path):
    """Notepad's files began with a strange character, or were no text at all."""
    file = tmp_path / "file.txt"
    file.write_text("Straße", encoding=encoding)
    assert read_text(file) == read_annotations(file) == "Straße"


def test_bytes_that_are_no_text_are_an_error_of_the_file(tmp_path):
    """Its callers say in one sentence what they expect instead."""
    file = tmp_path / "file.txt"
    file.write_bytes(b"car\xff")
    with pytest.raises(OSError, match="not UTF-8 text at byte 3"):
        read_text(file)
