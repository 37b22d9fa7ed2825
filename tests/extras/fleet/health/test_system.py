"""The machine of an edge, as its system tells."""

from pathlib import Path

from hvt_fleet.health.edge_metrics import SystemReading, read_system

WIRELESS = """\
Inter-| sta-|   Quality        |   Discarded packets               | Missed | WE
 face | tus | link level noise |  nwid  crypt   frag  retry   misc | beacon | 22
 wlan0: 0000   54.  -56.  -256        0      0      0      0     25        0
"""


def written(root: Path, *, zones: tuple[str, ...], wireless: str) -> Path:
    for number, text in enumerate(zones):
        zone = root / f"sys/class/thermal/thermal_zone{number}"
        zone.mkdir(parents=True)
        (zone / "temp").write_text(text)
    (root / "proc/net").mkdir(parents=True)
    (root / "proc/net/wireless").write_text(wireless)
    return root


def test_the_hottest_zone_and_the_wireless_link_are_read(tmp_path):
    """A board would throttle, or fly out of range, and nobody be told."""
    root = written(tmp_path, zones=("48250\n", "71000\n", "asleep\n"), wireless=WIRELESS)
    (root / "sys/class/thermal/thermal_zone2/temp").chmod(0)
    assert read_system(root) == SystemReading(temperature_c=71.0, wireless_quality=54.0, wireless_dbm=-56.0)


def test_what_the_system_does_not_tell_is_unknown(tmp_path):
    """A machine without sensors would be at 0 degrees, and its link at 0 dBm, which is superb."""
    assert read_system(tmp_path) == SystemReading()
    head = "".join(WIRELESS.splitlines(keepends=True)[:2])
    assert read_system(written(tmp_path, zones=(), wireless=head)) == SystemReading()
