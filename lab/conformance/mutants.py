"""``PYTHONPATH=. python -m lab.conformance.mutants``: break the TypeScript reader in many ways, one at a time.

Vectors are as good as the faults that they find: each mutant must fail one of them.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lab.conformance.schema import PATH
from lab.conformance.vectors import FOLDER

READER = Path(__file__).with_name("reader.ts")
_DRIVER = Path(__file__).with_name("mutants.js")


class Mutant(NamedTuple):
    """One fault: a text of the compiled reader, which is there once, and its replacement."""

    what: str
    before: str
    after: str


MUTANTS = [Mutant(*row) for row in json.loads(Path(__file__).with_suffix(".json").read_text("utf-8"))]


def built(folder: Path) -> Path:
    """The compiled reader; needs ``tsc``."""
    compiler = shutil.which("tsc")
    assert compiler is not None, "no TypeScript here (Debian: node-typescript)"
    settings = ["--target", "es2020", "--lib", "es2020", "--module", "commonjs", "--strict"]
    done = subprocess.run(
        [compiler, *settings, "--outDir", str(folder), str(READER)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stdout)
    return folder / "reader.js"


def survivors(reader: Path, mutants: Sequence[Mutant] = MUTANTS, *, vectors: Path = FOLDER) -> list[Mutant]:
    """Those of the mutants that pass all vectors; raises where the text of one is not there once."""
    text = reader.read_text(encoding="utf-8")
    for one in mutants:
        if text.count(one.before) != 1:
            raise ValueError(f"{one.what}: {one.before!r} is {text.count(one.before)} times in the reader")
    done = subprocess.run(
        ["node", str(_DRIVER), str(reader), str(PATH), str(vectors)],
        input=json.dumps([one[1:] for one in mutants]),
        capture_output=True,
        text=True,
        check=True,
    )
    return [mutants[number] for number in json.loads(done.stdout)]


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        alive = survivors(built(Path(folder)))
    for one in alive:
        print(f"survives: {one.what}")
    print(f"{len(MUTANTS) - len(alive)} of {len(MUTANTS)} mutants are caught")
    return bool(alive)


if __name__ == "__main__":
    sys.exit(main())
