"""The log of messages: what was written is read back, whatever happened to the file."""

import itertools
import os
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_archive.replay.message_log import MessageLog, read_log
from hvt_common.errors import UserError
from hvt_common.files import takes_lock
from hvt_common.transport.inbox import Received
from programs.small_disk import files_at_most, small_disk
from rigs.messages import INFO

MOST_BYTES = 10**9
MESSAGES = [
    Received(
        f"hvt/uav-1/{row}",
        bytes([number]) * number * 40,
        b"head" * (number % 3),
        "video/h265",
        10**18 + number,
    )
    for number, row in enumerate(("base", "roi", "status", "tracks", "info") * 4)
]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "flight.hvtlog"
    sink = MessageLog(path, most_bytes=MOST_BYTES)
    for one in MESSAGES:
        sink.log(one)
    sink.close()
    return path


def test_messages_come_back_as_they_came(log):
    """A replay would show another flight."""
    assert list(read_log(log)) == MESSAGES
    assert log.stat().st_size < 1.3 * sum(
        one.size_bytes + len(one.key) + len(one.encoding) for one in MESSAGES
    )


@pytest.mark.parametrize("lost", [1, 3, 8, 200, 5000])
def test_a_killed_ground_leaves_all_but_the_last_record(log, tmp_path, lost, caplog):
    """A power cut would take the whole flight; one that is damaged early would pass for a short one."""
    assert list(read_log(log)) == MESSAGES
    assert not caplog.messages
    cut_off = tmp_path / "cut.hvtlog"
    cut_off.write_bytes(log.read_bytes()[:-lost])
    found = list(read_log(cut_off))
    assert found == MESSAGES[: len(found)]
    assert len(found) >= len(MESSAGES) - 1 - lost // 600
    assert list(read_log(cut_off)) == found
    (said,) = caplog.messages
    assert f"{cut_off} breaks off" in said


@given(place=st.integers(8, 15_000), flipped=st.integers(1, 255))
def test_a_damaged_byte_takes_one_message_and_invents_none(log, place, flipped):
    """A bit that a card lost took the rest of the flight; a message that nobody sent would be taken for one."""
    data = bytearray(log.read_bytes())
    place = place % (len(data) - 8) + 8
    data[place] ^= flipped
    damaged = log.with_name("damaged.hvtlog")
    damaged.write_bytes(data)
    found = list(read_log(damaged))
    end, damaged_one, in_length = 8, 0, False
    for index in range(len(MESSAGES)):  # as the undamaged file has them
        at, end = end, end + 8 + struct.unpack_from("<I", log.read_bytes(), end)[0]
        if at <= place < end:
            damaged_one, in_length = index, place < at + 4
    if in_length:  # where the next begins is not known
        assert found == MESSAGES[:damaged_one]
    else:
        assert found == MESSAGES[:damaged_one] + MESSAGES[damaged_one + 1 :]


def test_a_record_that_claims_gigabytes_takes_no_memory(tmp_path):
    """A file from outside would end the process."""
    path = tmp_path / "large.hvtlog"
    path.write_bytes(b"HVTLOG\x00\x01" + struct.pack("<II", 2**32 - 1, 0) + bytes(100))
    assert list(read_log(path)) == []


def test_a_log_takes_no_more_than_was_allowed(tmp_path):
    """A ground that is left alone would fill the disk, and the newest would be what is missing."""
    path, most = tmp_path / "flight.hvtlog", 60_000
    sink = MessageLog(path, most_bytes=most)
    sink.log(Received("hvt/uav-1/info", INFO.pack(), b"", "", 10**18 - 2))
    for edge in range(20):  # what is no answer is not remembered, however often it comes
        sink.log(Received(f"hvt/forged-{edge}/info", bytes(2_000), b"", "", 10**18 - 1))
    messages = [one for one in MESSAGES if not one.key.endswith("/info")]
    for number in range(40):
        for one in messages:
            sink.log(replace(one, received_ns=one.received_ns + number * 100))
        there = [file.stat().st_size for file in tmp_path.iterdir()]
        assert sum(there) <= most
        assert len(there) <= 2
    sink.close()
    newest = list(read_log(path))
    assert newest[-1] == replace(messages[-1], received_ns=messages[-1].received_ns + 39 * 100)
    assert [one.key for one in newest if one.key.endswith("/info")] == ["hvt/uav-1/info"]
    assert newest[0].payload == INFO.pack(), "nothing can be read without it"
    every = sorted(one.received_ns for file in (sink.before, path) for one in read_log(file))
    assert len(set(every)) == len(every) - 1
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) > most / 3


def test_what_is_in_the_way_of_the_older_half_is_said(tmp_path):
    """A traceback, and a file that stays open."""
    (tmp_path / "flight-before.hvtlog").mkdir()
    with pytest.raises(UserError, match=r"flight-before\.hvtlog is in the way"):
        MessageLog(tmp_path / "flight.hvtlog", most_bytes=MOST_BYTES)


def test_what_no_edge_sends_ends_no_replay(tmp_path):
    """Anybody on the link could end what is read of a log with one large message."""
    sink = MessageLog(tmp_path / "flight.hvtlog", most_bytes=MOST_BYTES)
    for one in (MESSAGES[1], Received("hvt/intruder/base", bytes(5 * 2**20), b"", "", 1), MESSAGES[2]):
        sink.log(one)
    sink.close()
    assert list(read_log(tmp_path / "flight.hvtlog")) == MESSAGES[1:3]


def test_what_is_no_log_is_said(tmp_path):
    """A recording given by mistake would look like an empty flight."""
    wrong = tmp_path / "flight.rrd"
    wrong.write_bytes(b"RRF2" + bytes(20))
    with pytest.raises(UserError, match="is no message log"):
        list(read_log(wrong))
    with pytest.raises(UserError, match="No such file"):
        list(read_log(tmp_path / "absent.hvtlog"))
    os.mkfifo(pipe := tmp_path / "pipe")  # it waited for ever
    with pytest.raises(UserError, match="a pipe or a device, and no file"):
        list(read_log(pipe))


def test_a_full_disk_leaves_whole_records_and_no_lock(tmp_path):
    """What was kept so far would be lost with what found no room; or the next try call it another program's file."""
    path = tmp_path / "refused.hvtlog"
    with files_at_most(0), pytest.raises(UserError, match="cannot be created: File too large") as refused:
        MessageLog(path, most_bytes=MOST_BYTES)
    with path.open() as file:
        assert takes_lock(file.fileno()), refused
    with small_disk(tmp_path / "small", size="8k") as disk:
        sink = MessageLog(disk / "flight.hvtlog", most_bytes=MOST_BYTES)
        endless = itertools.cycle(MESSAGES)
        with pytest.raises(UserError, match="cannot be written any further: No space left on device"):
            _write_all(sink, endless)
        sink.close()
        found = list(read_log(disk / "flight.hvtlog"))
        assert found == MESSAGES[: len(found)]
        assert len(found) > 5


def _write_all(sink: MessageLog, messages: Iterator[Received]) -> None:
    for one in messages:
        sink.log(one)
