"""What is kept between runs of the study."""

from __future__ import annotations

import pytest

from hvt_common.errors import UserError
from hvt_study.cache.results import ResultCache, content_key, file_digest


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
