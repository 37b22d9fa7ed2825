"""Files that are written: whether a name still leads to one."""

import subprocess

import pytest

from hvt_common.files import check_there


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
