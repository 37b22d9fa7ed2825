"""Files that are written: whether a name still leads to one, and whether another program is at work on it."""

import errno
import fcntl
import os
import subprocess

import pytest

from hvt_common import files
from hvt_common.files import check_there, created, locked


def test_one_on_a_disk_that_was_unmounted_is_noticed(tmp_path):
    """A flight was recorded for hours where nobody could read it, and the report called it 0.00 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "tmpfs", disk], capture_output=True, check=False).returncode:
        pytest.skip("nobody but root mounts a disk, and not in every container")
    path = disk / "flight.rrd"
    with path.open("wb") as file:
        check_there(file.fileno(), path)
        subprocess.run(["umount", "--lazy", disk], check=True)
        with pytest.raises(FileNotFoundError, match="its disk was unmounted"):
            check_there(file.fileno(), path)


def test_one_that_was_moved_is_there(tmp_path):
    """A recording would end because its folder has another name."""
    (folder := tmp_path / "now").mkdir()
    path = folder / "flight.rrd"
    with path.open("wb") as file:
        folder.rename(tmp_path / "kept")
        check_there(file.fileno(), path)
        (tmp_path / "kept" / path.name).unlink()
        with pytest.raises(FileNotFoundError, match="it was removed"):
            check_there(file.fileno(), path)


def test_one_that_another_program_finished_meanwhile_is_left_as_it_is(tmp_path, monkeypatch):
    """A ground that had waited for the other's lock took its flight once it had it."""
    path = tmp_path / "flight"
    with path.open("wb", buffering=0) as other:
        fcntl.flock(other, fcntl.LOCK_EX)

        def finishes(_: float) -> None:
            other.write(b"flight")
            other.close()

        monkeypatch.setattr(files.time, "sleep", finishes)
        with pytest.raises(OSError, match="another program is at work on it"):
            created(path)
    assert path.read_bytes() == b"flight"


def test_who_cannot_have_a_lock_is_told(tmp_path, monkeypatch, caplog):
    """A study would wait without a word, or end after its flights where a disk has no locks."""
    path = tmp_path / ".lock"
    with locked(path), pytest.raises(ZeroDivisionError), locked(path, lambda: 1 / 0):
        pass
    opened = os.open

    def of_another(path, flags, *mode):
        if flags & os.O_RDWR:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, flags, *mode)

    def refused(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(os, "open", of_another)
    with locked(path), pytest.raises(ZeroDivisionError), locked(path, lambda: 1 / 0):
        pass
    with pytest.raises(PermissionError), locked(tmp_path / "other"):
        pass
    monkeypatch.setattr(fcntl, "flock", refused)
    for _ in range(2):
        with locked(path):
            pass
    assert caplog.text.count("takes no locks (No locks available)") == 1
