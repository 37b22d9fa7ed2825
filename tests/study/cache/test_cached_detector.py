"""What a detector said of a picture, kept between flights."""

import shutil

import numpy as np

from hvt_common.inference.store import resolve_model
from hvt_study.cache.results import CachedDetector

PICTURE = np.random.default_rng(3).integers(0, 255, (96, 128, 3), np.uint8)


def opened(folder, spec="aerial-nano", confidence=1e-6):
    return CachedDetector(str(spec), confidence=confidence, provider="cpu", folder=folder)


def entries(folder):
    return sorted(folder.iterdir())


def same(one, other):
    names = ("boxes_xyxy_px", "confidences", "class_ids")
    pairs = [(getattr(one, name), getattr(other, name)) for name in names]
    return all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in pairs)


def test_an_answer_comes_back_as_it_was_and_its_cost_is_known(tmp_path):
    """A table would change with what was in the cache, and the edge's CPU with it."""
    first = opened(tmp_path / "deep" / "memory").detect(PICTURE)
    again = opened(tmp_path / "deep" / "memory")
    before_s = again.saved_cpu_s
    assert same(again.detect(PICTURE), first)
    assert len(first) > 0
    assert again.saved_cpu_s > before_s
    assert len(entries(tmp_path / "deep" / "memory")) == 1


def test_a_model_goes_by_its_content(tmp_path):
    """A model that was trained again under its old name would give the old one's answers."""
    model, memory = tmp_path / "mine.onnx", tmp_path / "memory"
    shutil.copy(resolve_model("aerial-nano"), model)
    shutil.copy(model, tmp_path / "copy.onnx")
    for spec in ("aerial-nano", model, tmp_path / "copy.onnx"):
        opened(memory, spec).detect(PICTURE)
    assert len(entries(memory)) == 1  # one content, one answer, wherever it lies
    opened(memory, model, confidence=0.02).detect(PICTURE)
    assert len(entries(memory)) == 2
    other = tmp_path / "other.onnx"
    other.write_bytes(model.read_bytes() + b"\x72\x07\x0a\x01a\x12\x02bc")  # one entry of metadata more
    opened(memory, other).detect(PICTURE)
    assert len(entries(memory)) == 3
