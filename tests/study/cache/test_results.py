"""What is kept between runs of the study."""

import json
import shutil
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from hvt_common.errors import UserError
from hvt_study.cache.results import (
    DETECTING,
    FLYING,
    KINDS,
    ResultCache,
    code_digest,
    content_key,
    file_digest,
    flight_code,
    tree_digest,
)
from hvt_study.runs.run_context import model_digests, software_versions
from hvt_study.runs.spec import ModelChoice


def test_a_result_comes_back_as_it_was(tmp_path):
    """Numbers that change on the way would make a table that no run ever gave."""
    cache = ResultCache(tmp_path / "cache")
    result = {"total_bps": 123_456, "map_50": 0.1 + 0.2, "failed": "", "top1_large": None}
    key = content_key("clip", ["--method", "M5"], 800_000)
    assert cache.get(key) is None
    cache.put(key, result)
    assert ResultCache(tmp_path / "cache").get(key) == result


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-7], lambda data: data.replace(b"5", b"6"), lambda _: b""]
)
def test_a_damaged_result_is_made_again(tmp_path, damage, caplog):
    """A file that was cut off by a full disk would end the study, or worse, count."""
    cache = ResultCache(tmp_path)
    cache.put("abcdef", {"total_bps": 555})
    (path,) = tmp_path.glob("ab/*.json")
    path.write_bytes(damage(path.read_bytes()))
    assert cache.get("abcdef") is None
    assert "damaged" in caplog.text
    cache.put("abcdef", {"total_bps": 555})
    assert cache.get("abcdef") == {"total_bps": 555}


def test_two_machines_may_keep_the_same_at_once(tmp_path, monkeypatch):
    """Containers all have the same few process numbers: one would take the other's half file away."""
    hosts, replace = iter(("one", "other")), Path.replace

    def late(scratch, target):
        monkeypatch.setattr(Path, "replace", replace)
        ResultCache(tmp_path).put("abcdef", {"total_bps": 1})
        return replace(scratch, target)

    monkeypatch.setattr("platform.node", lambda: next(hosts))
    monkeypatch.setattr(Path, "replace", late)
    ResultCache(tmp_path).put("abcdef", {"total_bps": 2})
    assert ResultCache(tmp_path).get("abcdef") == {"total_bps": 2}


def test_a_folder_that_cannot_be_is_told_in_a_sentence(tmp_path):
    """A traceback in place of the path that is wrong."""
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be made"):
        ResultCache(tmp_path / "file" / "cache")
    (tmp_path / "ab").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        ResultCache(tmp_path).put("abcdef", {})


def test_content_decides_the_name(tmp_path):
    """A clip that was replaced under the same name would get the results of the old one."""
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"one")
    before = file_digest(clip)
    clip.write_bytes(b"two")
    assert file_digest(clip) != before
    assert content_key({"a": 1, "b": 2}) == content_key({"b": 2, "a": 1})
    with pytest.raises(UserError, match="cannot be read"):
        file_digest(tmp_path / "none")


def package(root, tracker="iou = 0.3\n", page="a", **more):
    """A package of two modules, or more, in folders of their own."""
    for name, text in {"__init__": "", "tracker": tracker, "report/page": page, **more}.items():
        path = root / "mine" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root / "mine"


def test_an_edit_is_another_code(tmp_path):
    """The figures of the old tracker would stand in the new one's table."""
    before = package(tmp_path / "before")
    own = tree_digest([before])
    assert tree_digest([package(tmp_path / "copy")]) == own
    page = package(tmp_path / "page", page="b")
    named = package(tmp_path / "named")
    (named / "kinds.toml").write_text('van = "car"\n')  # classes would be compared by the old table
    edits = (
        package(tmp_path / "edit", tracker="iou = 0.4\n"),
        package(tmp_path / "more", other=""),
        page,
        named,
    )
    assert own not in [tree_digest([edit]) for edit in edits]
    (before / "__pycache__").mkdir()
    shutil.copy(before / "tracker.py", before / "__pycache__" / "tracker.pyc")
    (before / ".cache" / "mine").mkdir(parents=True)
    for name in (".cache/mine/tracker.py", ".#tracker.py", "#tracker.py#", "tracker.py~", "tracker.py.orig"):
        shutil.copy(before / "tracker.py", before / name)
    assert tree_digest([page], without=["mine/report"]) == tree_digest([before], without=["mine/report"])


def test_what_runs_here_is_in_every_row():
    """Nobody could tell afterwards which HVT gave a table."""
    versions = json.loads(json.dumps(software_versions()))
    assert versions["code"] == flight_code()
    assert len(flight_code()) == 16
    assert code_digest("hvt_common") != flight_code()
    assert {"machine", "pillow", "msgpack"} <= versions.keys()


def test_each_kind_of_file_that_is_shipped_counts():
    """A table of another kind would be edited, and the figures of the old one would stand."""
    listed = subprocess.run(
        ["git", "ls-files", *(f"*/{name}/*" for name in FLYING)],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode:
        pytest.skip("no git here")
    files = listed.stdout.split()
    assert files
    assert not [name for name in files if not name.endswith(KINDS)]


def test_all_that_a_flight_loads_is_its_code():
    """A scene that is drawn otherwise would get the flights over the old one."""
    asked = "import hvt_study.runs.execute, sys; print(*{one.partition('.')[0] for one in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout
    assert {one for one in loaded.split() if one.startswith("hvt_")} <= set(FLYING)


@pytest.mark.parametrize("part", ["net.xml", "net.bin", "metadata.yaml"])
def test_a_network_goes_by_all_of_its_files(tmp_path, part):
    """An OpenVINO model that was trained again has other weights beside the same description."""
    for name in ("net.xml", "net.bin", "metadata.yaml"):
        (tmp_path / name).write_text("<net/>")
    models = ModelChoice(f"{tmp_path}/net.xml", f"{tmp_path}/net.xml", f"{tmp_path}/net.xml")
    before = model_digests(models)
    (tmp_path / part).write_text("<net></net>")
    model_digests.cache_clear()
    assert all(model_digests(models)[role] != digest for role, digest in before.items())


@pytest.mark.parametrize(
    ("group", "packages"), [("hvt.models", DETECTING), ("hvt.models", FLYING), ("hvt.still_codecs", FLYING)]
)
def test_what_comes_through_a_door_is_code_too(group, packages):
    """A head or a codec would be mended, and the figures of the broken one would stand."""
    own = {one.module.partition(".")[0] for one in entry_points(group=group) if one.dist.name == "hvt"}
    assert own
    assert own <= set(packages)
