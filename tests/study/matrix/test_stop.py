"""``hvt-study run`` that ends before it is done: full disk, interrupt, killed processes, and the start after."""

import os
import resource
import signal

import psutil
import pytest

from programs.processes import PATIENT_S
from studies.small_study import REGIME, arguments, entries, flights, said, study, table, until

pytestmark = pytest.mark.nightly

METHODS = ("--methods", "M0,R0,M5", "--regimes", "100kbps")


@pytest.mark.parametrize("full_for", ["detections", "flights"])
def test_a_full_disk_is_one_sentence_and_what_is_finished_stays(scene, tmp_path, full_for):
    """Hours of flights would be lost with the one that no longer fitted."""
    out = tmp_path / "out"
    first = study("run", *arguments(scene, out, "--methods", "M0", "--regimes", REGIME), folder=tmp_path)
    assert first.wait(PATIENT_S) == 0, said(tmp_path)
    before, rows = entries(out / "cache"), (out / "results.parquet").read_bytes()
    pictures, flight = (_sizes(out / "cache" / folder) for folder in ("detections", "flights"))
    limit = {"detections": min(pictures) // 2, "flights": (max(pictures) + min(flight)) // 2}[full_for]
    words = arguments(scene, out, "--methods", "M0,R0", "--regimes", REGIME, "--jobs", "1")
    small = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))}
    full = study("run", *words, folder=tmp_path, **small)
    assert full.wait(PATIENT_S) == 2, said(tmp_path)
    lines = said(tmp_path).splitlines()
    assert len([line for line in lines if "cannot be written (File too large)" in line]) == 1, lines
    assert lines[-1].startswith("hvt-study: ")
    assert not [line for line in lines if "Traceback" in line]
    after = entries(out / "cache")
    assert before.items() <= after.items()
    assert (out / "results.parquet").read_bytes() == rows


def test_killed_in_the_middle_it_goes_on_from_there(scene, tmp_path):
    """A lost machine would cost all that was flown on it."""
    out, words = tmp_path / "out", (*METHODS, "--jobs", "2")
    process = study("run", *arguments(scene, out, *words), folder=tmp_path, held=True)
    until(process, lambda: len(flights(out / "cache")) >= 2)
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait(PATIENT_S) == -signal.SIGKILL
    kept = {path: stamp for path, stamp in entries(out / "cache").items() if path.suffix == ".json"}
    assert len(kept) >= 2
    again = study("run", *arguments(scene, out, *words), folder=tmp_path)
    assert again.wait(PATIENT_S) == 0, said(tmp_path)
    assert kept.items() <= entries(out / "cache").items()
    order = [(row["method"], row["matched_to"]) for row in table(out)]
    assert order == [("M0", ""), ("R0", ""), ("M5", ""), ("M0", "M5"), ("R0", "M5")]
    assert all(row["matched"] for row in table(out))


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_nothing_is_left_running(scene, tmp_path, how):
    """Interrupted, it would go on in the background for hours, beside the study that is started again."""
    out = tmp_path / "out"
    process = study("run", *arguments(scene, out, *METHODS, "--jobs", "2"), folder=tmp_path, held=True)
    until(process, lambda: flights(out / "cache"))
    children = psutil.Process(process.pid).children(recursive=True)
    assert len(children) >= 2
    if how == signal.SIGINT:
        os.killpg(process.pid, how)  # as a terminal does
    else:
        process.kill()
    assert process.wait(PATIENT_S) == (130 if how == signal.SIGINT else -signal.SIGKILL)
    _, alive = psutil.wait_procs(children, timeout=PATIENT_S)
    assert not alive
    words = said(tmp_path)
    assert "Traceback" not in words
    if how == signal.SIGINT:
        assert words.endswith("hvt-study: interrupted\n")


def _sizes(folder):
    return [path.stat().st_size for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock"]
