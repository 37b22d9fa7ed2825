"""The reader on the drawn scene's own roofs."""

import socket

import cv2
import numpy as np
import pytest

from hvt_scene import Scene
from hvt_study.reading.score import CodeReader, code_crop

pytest.importorskip("rapidocr", reason="rapidocr is not installed: hvt[reading]")
AT_S = 3.0


@pytest.fixture(scope="module")
def scene():
    return Scene(0, codes=True)


@pytest.fixture(scope="module")
def reader():
    return CodeReader()


def read_right(reader, image, codes, *, scale=1.0):
    crops = [code_crop(image, (code.box_source_px * scale).tolist()) for code in codes]
    return np.mean([one.text == code.text for code, one in zip(codes, reader.read(crops), strict=True)])


def test_it_reads_the_source_and_not_what_has_lost_the_strokes(scene, reader):
    """A reader that cannot read the source says nothing of a link; one that reads a blur knows the truth."""
    image = scene.image(AT_S)
    codes = [code for code in scene.codes(AT_S) if code.visible > 0.95]
    assert len(codes) > 20
    codes = codes[:12]
    assert read_right(reader, image, codes) > 0.9
    small = cv2.resize(image, None, fx=1 / 6, fy=1 / 6, interpolation=cv2.INTER_AREA)
    assert read_right(reader, small, codes, scale=1 / 6) < 0.2


def test_it_reads_whichever_way_the_code_is_turned(scene, reader):
    """It would know the heading of a vehicle, which is truth beyond the box."""
    code = max((one for one in scene.codes(AT_S) if one.visible > 0.95), key=lambda one: one.height_px)
    crop = code_crop(scene.image(AT_S), code.box_source_px.tolist())
    ways = [np.ascontiguousarray(np.rot90(crop, quarter)) for quarter in range(4)]
    assert [one.text for one in reader.read(ways)] == [code.text] * 4


def test_nothing_is_fetched(monkeypatch, scene):
    """A study on a machine without a network would stop, or wait for one."""

    def refused(*_):
        raise OSError("no network here")

    monkeypatch.setattr(socket.socket, "connect", refused)
    monkeypatch.setattr(socket, "getaddrinfo", refused)
    code = scene.codes(AT_S)[0]
    (said,) = CodeReader().read([code_crop(scene.image(AT_S), code.box_source_px.tolist())])
    assert said.text
    assert said.picture_bgr.shape[1] > said.picture_bgr.shape[0]
