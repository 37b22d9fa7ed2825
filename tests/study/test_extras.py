"""Programs in an install without the extra that they need: one sentence that says what to install."""

import os
import subprocess
import sys

import pytest

STUDY = (
    *("faster_coco_eval", "jinja2", "matplotlib", "motmetrics", "optuna", "pandas", "pyarrow", "scipy"),
    *("sklearn", "yaml"),
)
GROUND = ("cryptography", "rerun")
BLOCK = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Refuse())
"""


def done(tmp_path, module, words, without):
    """The program in a Python that finds none of these packages."""
    (tmp_path / "sitecustomize.py").write_text(BLOCK.format(names=without))
    paths = [str(tmp_path), os.environ.get("PYTHONPATH", "")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", module, *words]
    return subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True, check=False)


def nightly(*case):
    return pytest.param(*case, marks=pytest.mark.nightly)


STUDIED = "hvt_study.cli"


@pytest.mark.parametrize(
    ("module", "words", "without", "install"),
    [
        (STUDIED, "run demo:0 --out out", (*STUDY, *GROUND), "hvt[study]"),
        nightly(STUDIED, "compare demo --detector aerial-nano --out o", GROUND, "hvt[study]"),
        nightly(STUDIED, "plan demo:0", ("rerun",), "hvt[study]"),
        nightly(STUDIED, "tune demo:0-1 --method M5 --out out", ("optuna",), "hvt[study]"),
        nightly(STUDIED, "report out", ("jinja2",), "hvt[study]"),
        (STUDIED, "read demo:codes --out out", ("rapidocr",), "hvt[reading]"),
        ("hvt_train", "curve log.jsonl --out out.svg", ("matplotlib",), "hvt[study]"),
        nightly(STUDIED, "score a.csv --truth gt.txt", ("sklearn",), "hvt[study]"),
        ("hvt_ground.cli", "--connect tcp/127.0.0.1:9", ("rerun",), "hvt[ground]"),
        ("hvt_ground.cli", "--cot udp://127.0.0.1:9 --connect tcp/127.0.0.1:9", ("pytak",), "hvt[cot]"),
        ("hvt_edge.cli", "--source demo --metrics 127.0.0.1:1", ("prometheus_client",), "hvt[metrics]"),
        ("hvt_ground.cli", "keys list", ("cryptography",), "hvt[ground]"),
        ("hvt_train", "detector --out out", ("torch",), "torch onnx"),
        (STUDIED, "train --data yolo:a --out b.onnx", ("torch",), "torch onnx"),
    ],
)
def test_a_missing_package_is_one_sentence(tmp_path, module, words, without, install):
    """Who installed hvt[edge] would get a traceback that names a package of somebody else."""
    (tmp_path / "a.csv").write_text("frame,x,y,w,h,class\n1,0,0,9,9,car\n")
    (tmp_path / "gt.txt").write_text("1,1,0,0,9,9,1,1,1\n")
    found = done(tmp_path, module, words.split(), without)
    assert found.returncode == 2, found.stderr
    assert f"pip install {install}".replace("hvt[", "'hvt[").replace("]", "]'") in found.stderr
    assert (
        len([one for one in found.stderr.splitlines() if not one.startswith("runs: ")]) == 1
    )  # the progress


def test_what_needs_no_extra_works_without_one(tmp_path):
    """The tracker alone and the selector sweep run where only the edge is installed."""
    for command in ("track", "sweep"):
        found = done(tmp_path, "hvt_study.cli", (command, "--help"), (*STUDY, *GROUND))
        assert found.returncode == 0, found.stderr
