"""Encoders that other packages install: found by name, checked, refused in a sentence."""

import math

import pytest

from hvt_common.errors import UserError
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.video.encoder import EncoderSettings, check_encoder, encoder_names, open_encoder
from hvt_edge.video.x265 import BaseEncoder
from media.clips import framed, smooth_pictures
from media.third_party import ENCODERS

SIZE = (320, 192)
SETTINGS = EncoderSettings(size=SIZE, fps=15.0, bitrate_bps=200_000, preset="ultrafast")


FRAMES = framed(smooth_pictures(6, size=SIZE))


def coded(encoder, *, keyframes):
    return [encoder.encode(frame, keyframe=frame.index in keyframes) for frame in FRAMES]


@pytest.fixture
def installed(packages):
    def put(*classes: str, module: str = "acme_encoders", **names: str) -> None:
        parts = {f"acme-{one.lower()}": one for one in classes} | names
        packages(parts, module=module, source=ENCODERS, group="hvt.encoders")

    return put


def test_another_encoder_makes_the_base_stream(installed):
    """The encoder of a board could not be used without changing HVT."""
    installed("Obedient")
    assert encoder_names()[:2] == ("x265", "acme-obedient")
    encoder, decoder = open_encoder("acme-obedient", SETTINGS), BaseDecoder(size=SIZE)
    units = coded(encoder, keyframes=(0, 4))
    assert [unit.keyframe for unit in units] == [True, False, False, False, True, False]
    assert [unit.capture_ns for unit in units] == [frame.capture_ns for frame in FRAMES]
    assert all(decoder.decode(unit.data) is not None for unit in units)
    assert math.isnan(encoder.mean_qp), "it does not say"
    assert isinstance(open_encoder("x265", SETTINGS), BaseEncoder)


def test_a_name_that_nobody_brings_is_answered_with_those_that_are_there(installed):
    """A typing mistake would be searched for in the documents."""
    installed("Obedient")
    says = "--encoder 'x266' is not known: choose one of x265, acme-obedient, hevc_nvenc, "
    with pytest.raises(UserError, match=says):
        check_encoder("x266")


def test_names_that_mean_something_else_are_refused(installed):
    """What --encoder x265 is would depend on what else is installed."""
    installed(x265="Obedient")
    with pytest.raises(UserError, match="encoder 'x265' is built in, and package acme_encoders"):
        check_encoder("x265")
    installed("Obedient", module="acme_one")
    installed("Obedient", module="acme_two")
    with pytest.raises(UserError, match="encoder 'acme-obedient' comes from both package acme_"):
        check_encoder("acme-obedient")


@pytest.mark.parametrize(
    ("name", "error", "says"),
    [
        ("Absent", UserError, "encoder 'acme-absent' of package acme_encoders .* OSError: no such device"),
        ("Late", ValueError, "it gave no access unit for frame 0"),
        ("WithoutKeyframes", ValueError, "frame 2 was to be a keyframe, and is no IDR"),
    ],
)
def test_one_that_does_not_open_or_that_no_ground_could_use_is_an_error(installed, name, error, says):
    """A traceback of somebody else's would come, or a ground that joins wait for a picture for ever."""
    installed(name)
    with pytest.raises(error, match=says):
        coded(open_encoder(f"acme-{name.lower()}", SETTINGS), keyframes=(0, 2))
