"""The vectors of docs/conformance: made by this code, and read by a reader that knows the documents alone."""

import io
import json
import re
import shutil
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from hvt_common.values import View
from hvt_common.video.base_crop import exact_base_crop
from hvt_common.video.still_codecs import BaseMissingError, still_codec, still_codec_names
from lab.conformance.mutants import MUTANTS, Mutant, built, survivors
from lab.conformance.schema import PATH
from lab.conformance.stills import FILE, vectors
from lab.conformance.vectors import FOLDER, files, schema_text


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    if shutil.which("tsc") is None or shutil.which("node") is None:
        pytest.skip("no TypeScript here (Debian: node-typescript)")
    return ["node", str(built(tmp_path_factory.mktemp("reader")))]


def run(reader: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*reader, str(PATH), str(folder)], capture_output=True, text=True, check=False)


def test_the_vectors_are_those_of_the_code():
    """Somebody else's reader would be tried on a wire that is no more."""
    written = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.json") if path != FILE}
    made = files()
    assert written.keys() == made.keys()
    stale = [name for name, text in made.items() if text != written[name]]
    stale += [PATH.name] * (PATH.read_text(encoding="utf-8") != schema_text())
    assert stale == [], "run python -m lab.conformance.vectors"


def test_an_independent_reader_reads_all_of_them(reader):
    """The documents would not be enough, or say something else than the code does."""
    done = run(reader, FOLDER)
    assert done.returncode == 0, done.stdout + done.stderr
    told = "messages refused objects track-steps poses backlog-dialogues base-orders report-traces stills still-cases"
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == [
        f"{one}.json" for one in told.split()
    ]


WRONG = [
    ("messages.json", '"sequence is at its bound", "hex": "98', '"sequence is at its bound", "hex": "99'),
    ("refused.json", '"version": true', '"version": false'),
    ("objects.json", '"values": [[7, 1000', '"values": [[8, 1000'),
    ("track-steps.json", '"width": ', '"width": 1'),
    ("poses.json", '"errors": [1', '"errors": [2'),
    ("stills.json", '"b": ', '"b": 1'),
    ("stills.json", '"pixels": "', '"pixels": "0'),
    ("stills.json", '"payload": "', '"payload": "00'),
]


def test_a_wrong_vector_is_noticed(reader, tmp_path):
    """A reader that passes whatever it is given proves nothing."""
    shutil.copytree(FOLDER, tmp_path / "vectors")
    expected = set()
    for name, before, after in WRONG:
        file = tmp_path / "vectors" / name
        lines = file.read_text(encoding="utf-8").splitlines()
        number = next(n for n, line in enumerate(lines) if before in line and (name, n) not in expected)
        lines[number] = lines[number].replace(before, after, 1)
        file.write_text("\n".join(lines), encoding="utf-8")
        expected.add((name, number))
    done = run(reader, tmp_path / "vectors")
    assert done.returncode == 1, done.stdout + done.stderr
    told = re.findall(r"^([\w-]+\.json) (\d+): ", done.stdout, re.MULTILINE)
    assert {(name, int(number) + 1) for name, number in told} == expected


def test_the_vectors_notice_a_broken_reader(reader):
    """Somebody's reader that is wrong at a bound would pass them; `python -m lab.conformance.mutants` tries all."""
    assert survivors(Path(reader[-1]), MUTANTS[::50]) == []


def test_a_mutant_that_is_none_is_noticed(reader):
    """Faults that are no longer in the reader, or change nothing, would count as caught."""
    same = Mutant("nothing", "if (at < data.length &&", "if (data.length > at &&")
    assert survivors(Path(reader[-1]), [same]) == [same]
    with pytest.raises(ValueError, match="0 times"):
        survivors(Path(reader[-1]), [Mutant("gone", "no such text", "")])


STILLS: list[dict[str, Any]] = [json.loads(line.rstrip(",")) for line in FILE.read_text().splitlines()[1:-1]]


def pixels(still: dict[str, Any]) -> np.ndarray:
    width, height = still["size"]
    return np.frombuffer(bytes.fromhex(still["pixels"]), np.uint8).reshape(height, width, 3)


def base_crop_of(still: dict[str, Any]) -> np.ndarray | None:
    """From the base picture, where the codec needs it."""
    if "base_planes" not in still:
        return None
    width, height = still["base_size"]
    planes = [
        np.frombuffer(bytes.fromhex(text), np.uint8).reshape(height // part, width // part)
        for text, part in zip(still["base_planes"], (1, 2, 2), strict=True)
    ]
    view = View((1, 1), (width, height), still["view_scale"], tuple(still["view_offset_px"]))
    return exact_base_crop(
        tuple(planes), view=view, crop_source_px=tuple(still["crop_source_px"]), size=tuple(still["size"])
    )


def near(found: np.ndarray, still: dict[str, Any]) -> bool:
    """Whether it is the picture of the vector, as near as the vector asks."""
    allowed = still.get("tolerance", {"mean": 0, "most": 0})
    off = np.abs(found.astype(int) - pixels(still))
    return bool(off.mean() <= allowed["mean"] and off.max() <= allowed["most"])


@pytest.mark.parametrize("still", STILLS, ids=lambda still: f"{still['codec']}: {still['what']}")
def test_the_code_reads_the_stills(still):
    """Edge and ground of two versions, or machines, would refuse each other's stills."""
    if still["codec"] not in still_codec_names():
        pytest.skip(f"{still['codec']} is not installed")
    base = base_crop_of(still)
    size, payload = tuple(still["size"]), bytes.fromhex(still["payload"])
    decode = partial(still_codec(still["codec"]).decode, payload, size=size, parameters=still["parameters"])
    assert near(decode(base_bgr=base), still)
    if base is not None:
        with pytest.raises(BaseMissingError):
            decode(base_bgr=base ^ 2)


@pytest.mark.parametrize("name", ["jpeg", "webp"])
def test_another_decoder_reads_the_picture_files(name):
    """The tolerance would be that of one library."""
    (still,) = [one for one in STILLS if one["codec"] == name]
    with Pillow.open(io.BytesIO(bytes.fromhex(still["payload"]))) as opened:
        theirs = np.asarray(opened.convert("RGB"))[..., ::-1]
    assert near(theirs, still)
    assert not near(theirs // 2, still)


def test_there_is_a_still_of_each_codec():
    """A reader would be tried on some of what an edge sends."""
    names = {still["codec"] for still in STILLS}
    assert names == {"jpeg", "webp", "avif", "jxl", "h264-intra", "residual"}
    if set(still_codec_names()) >= names:
        sent = [[(one["codec"], one["what"]) for one in those] for those in (vectors(), STILLS)]
        assert sent[0] == sent[1]
