"""``hvt-study run --dask``: a scheduler and two workers as processes of their own on loopback."""

import shutil
import subprocess
import sys
from contextlib import ExitStack

import pytest

from programs.processes import PATIENT_S, eventually, free_ports
from studies.small_study import arguments, detector, flights, holding, said, study, table, until

pytest.importorskip("distributed")
pytestmark = pytest.mark.nightly
WORDS = ("--methods", "M0,R0,M5", "--regimes", "100kbps")


class Cluster:
    """Two workers of one thread, that nobody starts again; the first stands still after its flight."""

    def __init__(self, folder):
        (port,) = free_ports(1)
        self.address = f"tcp://127.0.0.1:{port}"
        self._folder, self._stack = folder, ExitStack()
        local = ("--host", "127.0.0.1", "--no-dashboard")
        self.scheduler = self._start("scheduler", *local, "--port", str(port))
        alone = (*local, "--nthreads", "1", "--no-nanny", "--memory-limit", "0")
        environments = (holding(folder, kept=1), None)
        self.workers = [self._start("worker", self.address, *alone, env=env) for env in environments]

    def _start(self, what, *words, env=None):
        log = self._stack.enter_context((self._folder / f"{what}.log").open("a"))
        code = f"from distributed.cli.dask_{what} import main; main()"
        command, log = [sys.executable, "-c", code, *words], {"stdout": log, "stderr": log}
        process = subprocess.Popen(command, cwd=self._folder, stdin=subprocess.DEVNULL, env=env, **log)
        self._stack.callback(process.wait, PATIENT_S)
        self._stack.callback(process.kill)
        return process

    def ready(self):
        return (self._folder / "worker.log").read_text().count("Registered to") == 2

    def __enter__(self):
        with ExitStack() as stack:
            stack.push(self._stack)  # where they do not
            eventually(self.ready, what="two workers have found their scheduler")
            stack.pop_all()
        return self

    def __exit__(self, *_):
        self._stack.close()


def test_a_worker_is_lost_in_mid_run(scene, tmp_path):
    """One machine of a cluster that goes away would take a night's work with it, or change the table.

    Paths that are not absolute begin where the study was started: workers were started somewhere else.
    """
    out, alone = tmp_path / "out", tmp_path / "alone"
    home = tmp_path / "home"
    home.mkdir()
    shutil.copy(detector(scene), home / "nano.onnx")
    (home / "flights").symlink_to(scene.removeprefix("visdrone:").removesuffix("?fps=15"))
    scene, words = "visdrone:flights?fps=15", (*WORDS, "--detector", "nano.onnx")
    with Cluster(tmp_path) as cluster:
        asked = arguments(scene, out, *words, "--dask", cluster.address)
        process = study("run", *asked, folder=tmp_path, cwd=home)
        until(process, lambda: flights(out / "cache"))
        cluster.workers[0].kill()
        assert process.wait(PATIENT_S) == 0, said(tmp_path)
        assert cluster.workers[0].poll() is not None
        assert cluster.workers[1].poll() is None
        assert "5 runs, 0 failed" in (tmp_path / "study.out").read_text()
        assert "Traceback" not in said(tmp_path)
    process = study("run", *arguments(scene, alone, *words, "--jobs", "1"), folder=tmp_path, cwd=home)
    assert process.wait(PATIENT_S) == 0, said(tmp_path)
    assert table(out) == table(alone)
    assert len(table(out)) == 5
    assert {(row["dataset"], row["detector"]) for row in table(out)} == {(scene, "nano.onnx")}


def test_a_cluster_that_is_lost_is_told_in_a_sentence(scene, tmp_path):
    """It would wait for ever for a scheduler that is gone, or end in a traceback of somebody else's code."""
    out = tmp_path / "out"
    with Cluster(tmp_path) as cluster:
        process = study("run", *arguments(scene, out, *WORDS, "--dask", cluster.address), folder=tmp_path)
        until(process, lambda: flights(out / "cache"))
        cluster.scheduler.kill()
        assert process.wait(PATIENT_S) == 2, said(tmp_path)
    last = said(tmp_path).splitlines()[-1]
    assert "the scheduler was lost" in last
    assert "finished runs are kept" in last
    assert "Traceback" not in said(tmp_path)
    assert flights(out / "cache")


def test_no_scheduler_is_told_in_a_sentence(scene, tmp_path):
    """A wrong address would be a page of asyncio."""
    (port,) = free_ports(1)
    address = f"tcp://127.0.0.1:{port}"
    process = study("run", *arguments(scene, tmp_path / "out", *WORDS, "--dask", address), folder=tmp_path)
    assert process.wait(PATIENT_S) == 2
    assert "Traceback" not in said(tmp_path)
    assert said(tmp_path).splitlines()[-1].startswith(f"hvt-study: --dask {address}: no scheduler answers (")
