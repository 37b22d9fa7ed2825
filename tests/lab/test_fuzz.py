"""A short run of the fuzzer's targets in the normal tests, what it once found, and the fuzzer itself.

`make fuzz` is the long run. The short one takes the same targets and seeds with mutations of its own: no libFuzzer,
no coverage, the same inputs every time.
"""

import json
import os
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path
from random import Random

import msgpack
import pytest

from hvt_common.protocol.messages import Status
from lab.fuzz.__main__ import main
from lab.fuzz.contract import CannotStartError, Target, checked_seeds
from lab.fuzz.mutate import changed_values, joined, parted, plain, with_checksum
from lab.fuzz.table import PLANTED, TARGETS

ROOT = Path(__file__).resolve().parents[2]
FOUND = ROOT / "lab" / "fuzz" / "found"
TESTS = ROOT / "tests" / "support"
NAMES = [name for name, target in TARGETS.items() if target is not PLANTED]


@pytest.mark.parametrize("name", NAMES)
def test_no_input_breaks_anything(name):
    """Whoever reaches the link, or leaves a file where it is read, could end the process."""
    target, rng = TARGETS[name], Random(7)
    seeds = checked_seeds(target)
    assert seeds == list(target.seeds()), "a second process, or a second call, begins with the same"
    assert target.short >= 100
    for number in range(target.short):
        data = target.mutate(rng.choice(seeds), rng, plain(rng))[: target.most_bytes]
        try:
            target.run(data)
        except Exception as error:
            found = Path("build/fuzz/found") / f"{name}-short"
            found.parent.mkdir(parents=True, exist_ok=True)
            found.write_bytes(data)
            raise AssertionError(f"input {number} of {name}, now in {found}: {error!r}") from error


@pytest.mark.parametrize(
    "path",
    [one for one in sorted(FOUND.glob("*/*")) if one.is_file()],
    ids=lambda path: f"{path.parent.name}/{path.name}",
)
def test_what_was_found_once_stays_mended(path):
    """It would come back with the next change."""
    TARGETS[path.parent.name].run(path.read_bytes())


def test_a_mutation_of_a_long_message_does_not_fill_the_memory():
    """Its array of thousands was repeated thousands of times, and each further round multiplied again."""
    long_message = with_checksum(msgpack.packb([[*range(3000)], 5, 6, 0])[:-1])
    sizes = [len(changed_values(long_message, rng, plain(rng))) for rng in map(Random, range(1200))]
    assert max(sizes) < 20 * len(long_message)


def test_mutations_get_past_the_checksum():
    """The fuzzer would see the checksum refuse a million inputs, and nothing behind it."""
    rng = Random(3)
    (seed,) = TARGETS["status"].seeds()
    mutated = [changed_values(seed, rng, plain(rng)) for _ in range(300)]
    sealed = [data for data in mutated if with_checksum(data[:-5]) == data]
    assert len(sealed) > 0.8 * len(mutated)
    assert len(set(sealed)) > 200
    assert Status.parse(seed)


def test_parts_come_back():
    """A part of an input could not be changed by itself."""
    parts = [b"", b"ab", bytes(300)]
    assert parted(joined(parts)) == parts
    assert parted(b"\0\0\x09cut", least=2) == [b"cut", b""]
    assert parted(b"") == [b""]


@pytest.mark.parametrize(
    ("seeds", "why"),
    [(list, "it has no seeds"), (lambda: 1 / 0, "division by zero"), (lambda: [b"t"], "here to be found")],
)
def test_a_target_that_cannot_start_is_an_error_at_once(seeds, why):
    """The weightiest target was not tried for weeks, and nothing said so."""
    target = Target("idle", PLANTED.run, seeds)
    with pytest.raises(CannotStartError, match=f"target idle cannot start.*{why}"):
        checked_seeds(target)


def test_the_run_ends_before_any_input_where_a_target_cannot_start(tmp_path, monkeypatch, capsys):
    """An hour later the table would show that one target had no inputs."""
    monkeypatch.setitem(TARGETS, "units", Target("units", TARGETS["units"].run, list))
    assert main(["--runs", "10", "--folder", str(tmp_path)]) == 2
    assert "target units cannot start: it has no seeds" in capsys.readouterr().err
    assert not (tmp_path / "summary.json").exists()


@pytest.mark.nightly
@pytest.mark.skipif(find_spec("atheris") is None, reason="atheris is not installed: dependency group 'fuzz'")
def test_the_fuzzer_finds_a_planted_bug_and_keeps_its_input(tmp_path):
    """A million inputs would be reported as harmless by a fuzzer that sees nothing."""
    command = [sys.executable, "-m", "lab.fuzz", "--runs", "4000", "--folder", str(tmp_path)]
    command += ["--target", "planted", "--findings", "1"]
    ended = subprocess.run(
        command,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(TESTS), *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1, ended.stderr
    (planted,) = json.loads((tmp_path / "summary.json").read_text())
    assert planted["inputs"] < 4000
    assert planted["coverage"] > 0, "edges of our own code are counted"
    assert "here to be found" in planted["findings"][0]
    kept = next((tmp_path / "found").glob("planted-crash-*"))
    with pytest.raises(ValueError, match="here to be found"):
        PLANTED.run(kept.read_bytes())


@pytest.mark.skipif(find_spec("atheris") is None, reason="atheris is not installed")
def test_the_fuzzer_sees_all_code_that_flies():
    """What moves to another package would be fuzzed blindly: no input would be kept for what it reaches."""
    from lab.fuzz.worker import FLIES

    build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    packages = [Path(one) for one in build["targets"]["wheel"]["packages"]]
    assert set(FLIES) == {one.name for one in packages if one.parent.name != "study"}


@pytest.mark.skipif(find_spec("atheris") is None, reason="atheris is not installed")
def test_memory_that_the_fuzzer_takes_is_no_finding(tmp_path):
    """A target would be left alone for what it never did; and one that takes too much would not be found."""
    from lab.fuzz.worker import Watched

    mb = 1024
    taken = iter([0, 0] * 300 + [300 * mb, 301 * mb, 301 * mb, 401 * mb])
    watched = Watched(PLANTED, runs=1000, path=tmp_path / "planted.json", peak_kb=lambda: next(taken))
    for _ in range(301):
        watched(b"")
    with pytest.raises(MemoryError, match="one input took 100 MB"):
        watched(b"")
