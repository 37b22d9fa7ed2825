"""Whether all that an edge and a ground need comes as a ready wheel for 64-bit ARM, such as a Raspberry Pi or Jetson.

    python deploy/arm_wheels.py

Asks the package registry as pip would on such a board, installs nothing, prints a line for each install and Python,
and ends with code 1 where something would have to be compiled there.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PYTHONS = ("3.11", "3.12", "3.13")
# Debian 12 and Ubuntu 24.04 have a newer glibc than any of these asks for.
PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in (35, 34, 31, 28, 27, 17)] + ["manylinux2014_aarch64"]


def requirements(extra: str) -> list[str]:
    """What pyproject names for ``hvt[extra]``; extras of our own taken apart."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    found, open_extras = list(project["dependencies"]), [extra]
    while open_extras:
        for one in project["optional-dependencies"][open_extras.pop()]:
            if one.startswith("hvt["):
                open_extras += one[len("hvt[") :].rstrip("]").split(",")
            else:
                found.append(one)
    return found


def wheels(extra: str, python: str) -> list[str]:
    """The files that pip would install; raises `CalledProcessError` where there is none for something."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        platforms = [word for one in PLATFORMS for word in ("--platform", one)]
        subprocess.run(
            [
                *(sys.executable, "-m", "pip", "install", "--quiet", "--quiet", "--dry-run"),
                *("--only-binary=:all:", "--python-version", python, *platforms),
                *("--target", folder, "--report", str(report), *requirements(extra)),
            ],
            check=True,
        )
        installed = json.loads(report.read_text())["install"]
    return [one["download_info"]["url"].rsplit("/", 1)[-1] for one in installed]


def main() -> int:
    """Return 0 where all are there."""
    missing = 0
    for extra in ("edge", "ground"):
        for python in PYTHONS:
            name = f"hvt[{extra}], Python {python}, aarch64"
            try:
                found = wheels(extra, python)
            except subprocess.CalledProcessError:
                print(f"{name}: something has no wheel (see above)")
                missing += 1
            else:
                built = sum("aarch64" in one for one in found)
                print(f"{name}: {len(found)} wheels, {built} of them built for ARM")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
