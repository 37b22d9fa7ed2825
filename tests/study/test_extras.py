"""Programs in an install without the extra that they need: one sentence that says what to install."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

STUDY = (
    *("faster_coco_eval", "jinja2", "matplotlib", "motmetrics", "pandas", "pyarrow", "scipy"),
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
    return subprocess.run(
        [sys.executable, "-m", module, *words],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("module", "words", "without", "install"),
    [
        ("hvt_study.cli", ("run", "demo:0", "--out", "out"), (*STUDY, *GROUND), "hvt[study]"),
        pytest.param(
            "hvt_study.cli",
            ("compare", "demo", "--detector", "aerial-nano", "--out", "o"),
            GROUND,
            "hvt[study]",
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            "hvt_study.cli", ("report", "out"), ("jinja2",), "hvt[study]", marks=pytest.mark.nightly
        ),
        ("hvt_study.cli", ("read", "demo:codes", "--out", "out"), ("rapidocr",), "hvt[reading]"),
        ("hvt_train", ("curve", "log.jsonl", "--out", "out.svg"), ("matplotlib",), "hvt[study]"),
        ("hvt_ground.cli", ("--connect", "tcp/127.0.0.1:9"), ("rerun",), "hvt[ground]"),
        (
            "hvt_ground.cli",
            ("--cot", "udp://127.0.0.1:9", "--connect", "tcp/127.0.0.1:9"),
            ("pytak",),
            "hvt[cot]",
        ),
        (
            "hvt_edge.cli",
            ("--source", "demo", "--metrics", "127.0.0.1:1"),
            ("prometheus_client",),
            "hvt[metrics]",
        ),
        ("hvt_ground.cli", ("keys", "list"), ("cryptography",), "hvt[ground]"),
        ("hvt_train", ("detector", "--out", "out"), ("torch",), "torch onnx"),
        ("hvt_study.cli", ("train", "--data", "yolo:a", "--out", "b.onnx"), ("torch",), "torch onnx"),
    ],
)
def test_a_missing_package_is_one_sentence(tmp_path, module, words, without, install):
    """Who installed hvt[edge] would get a traceback that names a package of somebody else."""
    found = done(tmp_path, module, words, without)
    assert found.returncode == 2, found.stderr
    assert f"pip install {install}".replace("hvt[", "'hvt[").replace("]", "]'") in found.stderr
    assert len([one for one in found.stderr.splitlines() if "opening what they need" not in one]) == 1
