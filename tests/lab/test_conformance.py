"""The vectors of docs/conformance: made by this code, and read by a reader that knows the documents alone."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from lab.conformance.vectors import FOLDER, files

READER = Path(__file__).resolve().parents[2] / "lab" / "conformance" / "reader.ts"


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command that runs it."""
    compiler, node = shutil.which("tsc"), shutil.which("node")
    if compiler is None or node is None:
        pytest.skip("no TypeScript here (Debian: node-typescript)")
    out = tmp_path_factory.mktemp("reader")
    settings = [
        "--target",
        "es2020",
        "--lib",
        "es2020",
        "--module",
        "commonjs",
        "--strict",
        "--outDir",
        str(out),
    ]
    done = subprocess.run([compiler, *settings, str(READER)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    return [node, str(out / "reader.js")]


def run(reader: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Over all files of a folder."""
    return subprocess.run([*reader, str(folder)], capture_output=True, text=True, check=False)


def test_the_vectors_are_those_of_the_code():
    """Somebody else's reader would be tried on a wire that is no more."""
    written = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.json")}
    assert written.keys() == files().keys()
    stale = [name for name, text in files().items() if text != written[name]]
    assert stale == [], "run PYTHONPATH=.:tests/support python -m lab.conformance.vectors"


def test_an_independent_reader_reads_all_of_them(reader):
    """The documents would not be enough, or say something else than the code does."""
    done = run(reader, FOLDER)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == [
        *("messages.json", "refused.json", "objects.json", "track-steps.json"),
    ]


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("messages.json", '"sequence at its bound", "hex": "98', '"sequence at its bound", "hex": "99'),
        ("refused.json", '"version": true', '"version": false'),
        ("objects.json", '"values": [[7, 1000', '"values": [[8, 1000'),
        ("track-steps.json", '"width": ', '"width": 1'),
    ],
)
def test_a_wrong_vector_is_noticed(reader, tmp_path, name, before, after):
    """A reader that passes whatever it is given proves nothing."""
    shutil.copytree(FOLDER, tmp_path / "vectors")
    file = tmp_path / "vectors" / name
    text = file.read_text(encoding="utf-8")
    assert before in text
    file.write_text(text.replace(before, after, 1), encoding="utf-8")
    done = run(reader, tmp_path / "vectors")
    assert done.returncode == 1
    assert f"{name} " in done.stdout
