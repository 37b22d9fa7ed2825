"""Asking from the ground, against a scripted edge on a real link: what is believed, what is said, what is written."""

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import zenoh

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import ControlAnswer, ControlRequest
from hvt_common.transport.session import declare_publisher, open_session, serve
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_common.video.still_codecs import JpegCodec
from hvt_fleet.commands import run
from hvt_ground import control
from hvt_ground.cli import main
from hvt_ground.control import EdgeClient, RefusedError, RemoteEdge, RequestedStill
from programs.processes import PATIENT_S, eventually
from rigs import messages

KEYS = EdgeKeys("uav-1")
PICTURE = cv2.resize(
    np.random.default_rng(1).integers(0, 255, (8, 12, 3), np.uint8), (96, 64), interpolation=cv2.INTER_CUBIC
)
DATA = JpegCodec().encode(PICTURE, quality_pct=90).data
INFO = replace(
    messages.INFO,
    session_id=7,
    source_size=(960, 540),
    base_size=(640, 360),
    view_scale=2 / 3,
    class_names=("car",),
)
YES = ControlAnswer(session_id=7, accepted=True, reason="", still_request=3, frame_index=40, tracks=())
HEADER = replace(
    messages.ROI,
    session_id=7,
    sequence=9,
    frame_index=40,
    track_id=-1,
    box_source_px=(10.0, 20.0, 106.0, 84.0),
    crop_source_px=(10, 20, 106, 84),
    class_name="",
    reason="asked",
    parameters={"ask": 3},
    also=(),
)


class ScriptedEdge:
    """Answers everything with ``answer``, and a little later publishes ``puts``, if it was asked for ``puts_at``."""

    def __init__(self, port: int) -> None:
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self.answer, self.outcome = YES, YES
        self.puts: list[tuple[bytes, bytes]] = [(DATA, HEADER.pack(DATA))]
        self.asked: list[ControlRequest] = []
        self.puts_at = "still"
        self.ends, self.answers = False, True

    def control(self, question: bytes) -> bytes | None:
        if not self.answers:
            return None
        request = ControlRequest.parse(question)
        self.asked.append(request)
        if request.command == self.puts_at and self.answer.accepted:
            threading.Timer(0.1, self._put).start()
        return (self.outcome if request.command == "still-outcome" else self.answer).pack()

    def _put(self) -> None:
        for payload, attachment in self.puts:
            self._publisher.put(payload, attachment=attachment, encoding="image/jpeg")
        if self.ends:
            self._status.put(replace(messages.STATUS, session_id=7, state="ended").pack())

    def serve(self, session: zenoh.Session) -> None:
        self._publisher = declare_publisher(session, Channel.ROI, keys=KEYS)
        self._status = declare_publisher(session, Channel.STATUS, keys=KEYS)
        serve(session, Channel.INFO, keys=KEYS, answer=lambda _question: INFO.pack())
        serve(session, Channel.CONTROL, keys=KEYS, answer=self.control)


@pytest.fixture
def edge(free_port, monkeypatch) -> Iterator[ScriptedEdge]:
    monkeypatch.setattr(control, "ANSWER_S", PATIENT_S)
    scripted = ScriptedEdge(free_port)
    with (
        open_session(LinkSettings("edge", listen=(scripted.endpoint,))) as session,
        session.liveliness().declare_token(KEYS[Channel.ALIVE]),
    ):
        scripted.serve(session)
        yield scripted


@pytest.fixture
def uav(edge) -> Iterator[RemoteEdge]:
    with EdgeClient.connect(edge.endpoint) as edges:
        yield edges["uav-1"]


def test_the_still_of_the_number_is_the_one_that_is_returned(edge):
    """Another's still, or one made up by a stranger, would be shown as the answer."""
    other = np.zeros_like(PICTURE)
    black = JpegCodec().encode(other, quality_pct=90).data
    edge.puts = [
        (black, replace(HEADER, parameters={"ask": 2}).pack(black)),
        (black, replace(HEADER, parameters={}).pack(black)),
        (black, replace(HEADER, session_id=8).pack(black)),
        (black, b"nonsense"),
        (black[:-9], HEADER.pack(black)),
        *edge.puts,
    ]
    with EdgeClient.connect(edge.endpoint) as edges:
        assert edges.names() == ["uav-1"]
        still = edges["uav-1"].still(box=(10, 20, 96, 64), at_s=-1.5, quality_pct=90, timeout_s=PATIENT_S)
    assert edge.asked[0].arguments == {"x": 10, "y": 20, "w": 96, "h": 64, "at_ms": -1500, "quality": 90}
    assert (still.edge, still.header, still.data) == ("uav-1", HEADER, DATA)
    assert cv2.PSNR(still.image_bgr, PICTURE) > 30


@pytest.mark.parametrize(
    "changes",
    [
        {"crop_source_px": (0, 0, 5000, 5000)},
        {"crop_source_px": (10, 20, 500, 400)},
        {"codec": "residual"},
        {"codec": "own"},
    ],
)
def test_a_still_that_cannot_be_one_is_a_sentence(edge, uav, changes):
    """A hostile edge could make the operator's machine decode anything, or end in a traceback."""
    edge.puts = [(DATA, replace(HEADER, **changes).pack(DATA))]
    with pytest.raises(UserError, match="cannot be decoded"):
        uav.still(timeout_s=PATIENT_S)


def test_refusals_are_the_edges_own_words(edge, uav):
    """The operator would not know what to ask instead."""
    edge.answer = replace(YES, accepted=False, reason="there is no track 9 at frame 4")
    for ask in (lambda: uav.still(track=9), lambda: uav.set_budget(5)):
        with pytest.raises(RefusedError, match="uav-1 refuses: there is no track 9 at frame 4"):
            ask()


def test_where_two_edges_have_one_name_neither_is_taken_for_the_other(edge, uav):
    """The still was of whichever answered first, its tracks had the classes of the other, and both were commanded."""

    def refused(request: Callable[[], object]) -> bool:
        with suppress(UserError):
            request()
            return False
        return True

    with open_session(LinkSettings("edge", connect=(edge.endpoint,))) as other:
        serve(other, Channel.CONTROL, keys=KEYS, answer=lambda _: replace(YES, session_id=8).pack())
        serve(other, Channel.INFO, keys=KEYS, answer=lambda _: replace(INFO, session_id=8).pack())
        eventually(lambda: refused(uav.info), what="the other is known")
        for request in (uav.info, uav.still, uav.tracks, partial(uav.set_budget, 5)):
            with pytest.raises(
                UserError, match="two edges call themselves uav-1, and both have answered: stop one"
            ):
                request()
    assert edge.asked == []


def test_a_command_is_for_the_session_that_answered(edge, uav):
    """A second edge of that name, whose own answer comes too late, would obey, or its refusal be told."""
    heard: list[ControlRequest] = []
    ended = replace(YES, session_id=8, accepted=False, reason="that session has ended").pack()

    def refuse(question: bytes) -> bytes:
        heard.append(ControlRequest.parse(question))
        return ended

    with open_session(LinkSettings("edge", connect=(edge.endpoint,))) as other:
        serve(other, Channel.CONTROL, keys=KEYS, answer=refuse)
        eventually(lambda: uav.keyframe() or heard, what="the other is asked")
        uav.set_budget(5)
        assert uav.tracks() == []
        assert uav.still(timeout_s=PATIENT_S).header.session_id == 7
        assert {one.session_id for one in (*edge.asked, *heard)} == {7}
        edge.answers = False
        with pytest.raises(
            RefusedError, match="session of uav-1 that was asked does not answer, and another"
        ):
            uav.keyframe()


def test_a_still_that_was_given_up_is_not_waited_for(edge, uav):
    """The operator would look at nothing until the timeout, and then not know why."""
    edge.puts = []
    edge.outcome = replace(YES, accepted=False, reason="in 10 s the budget had no room for it")
    with pytest.raises(RefusedError, match="no room for it"):
        uav.still(timeout_s=PATIENT_S)
    assert [(one.command, one.arguments) for one in edge.asked] == [
        ("still", {}),
        ("still-outcome", {"ask": 3}),
    ]


@pytest.mark.parametrize(
    ("ends", "timeout_s", "said"),
    [(True, PATIENT_S, "uav-1 has ended"), (False, 0.5, r"not come within 0\.5 s")],
)
def test_a_still_that_does_not_come_any_more_is_said(edge, uav, ends, timeout_s, said):
    """The operator would blame the budget, and wait for an edge that has landed; a program hang with the link."""
    edge.puts, edge.ends = [], ends
    with pytest.raises(UserError, match=said):
        uav.still(timeout_s=timeout_s)


def test_how_it_comes_is_said_before_it_comes(edge, tmp_path, capsys):
    """A picture that takes seconds, or shows less than was asked for, would be a riddle."""
    edge.puts_at = "still-outcome"
    edge.outcome = replace(YES, note="96x64 pixels at quality 40 come within about 3 s")
    words = ["still", "--connect", edge.endpoint, "--timeout", "60s", "--out", str(tmp_path / "crop.png")]
    assert main(words) == 0
    assert capsys.readouterr().out.startswith("uav-1: 96x64 pixels at quality 40 come within about 3 s\n")


def test_an_answer_that_is_none_is_a_sentence(edge):
    """A traceback would say nothing of the edge that is not there."""
    with EdgeClient.connect(edge.endpoint) as edges:
        with pytest.raises(UserError, match="edge 'uav-9' does not answer"):
            edges["uav-9"].keyframe()
        with pytest.raises(UserError, match="edge id 'UAV 1'"):
            edges["UAV 1"].keyframe()
        edge.answers = False  # and nobody looks for rights where there are no keys
        said = r"uav-1 does not answer on control: the link is full, or has lost it$"
        with pytest.raises(UserError, match=said):
            edges["uav-1"].keyframe()


def test_the_command_finds_the_only_edge_and_writes_the_file_as_it_came(edge, tmp_path, capsys):
    """The picture on disk would have lost twice; `--at -3s` would be taken for a flag."""
    out = tmp_path / "crop.jpg"
    words = ["still", "--connect", edge.endpoint, "--track", "17", "--at", "-3s", "--timeout=60s"]
    words += ["--out", str(out)]
    assert main(words) == 0
    assert out.read_bytes() == DATA
    assert edge.asked[0].arguments == {"track": 17, "at_ms": -3000}
    assert "frame 40, 96x64 pixels at 10,20" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "asked"),
    [
        (["keyframe"], ("keyframe", {})),
        (["set-budget", "600kbps"], ("set-budget", {"bps": 600_000})),
        (["set-method", "M6"], ("set-method", {"method": "M6"})),
        (["tracks"], ("tracks", {})),
    ],
)
def test_the_other_commands_ask_what_they_say(edge, words, asked):
    """The edge would do something else."""
    assert run([*words, "--connect", edge.endpoint, "--edge", "uav-1"]) == 0
    assert [(one.command, one.arguments) for one in edge.asked] == [asked]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["still", "--out", "crop.tif"], "crop.tif is not a picture that can be written"),
        (["still"], "--out"),
        (["still", "--out", "/proc/a.png"], "--out /proc/a.png cannot be written"),
        (["still", "--box", "1,2,3", "--out", "a.png"], "--box '1,2,3' is not a box"),
        (["still", "--box", "1,2,3,4", "--track", "5", "--out", "a.png"], "not allowed with"),
        (["still", "--at", "soon", "--out", "a.png"], "--at 'soon' is not a duration"),
        (["set-budget", "much"], "the budget 'much' is not a bitrate"),
        (["keyframe", "--edge", "UAV 1"], "--edge 'UAV 1' is not usable"),
        (["keyframe", "--connect", "nowhere"], "--connect 'nowhere' is not usable"),
        (["still", "--track", "x", "--out", "a.png"], "is not accepted: give a whole number"),
    ],
)
def test_wrong_words_are_one_sentence_before_anybody_is_asked(words, said, capsys):
    """The user would wait for a link to be told of a typing error."""
    assert main(words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_where_nobody_listens_it_says_so(free_port, capsys):
    """The command would hang."""
    assert main(["keyframe", "--connect", f"tcp/127.0.0.1:{free_port}"]) == 2
    assert f"nobody answers at tcp/127.0.0.1:{free_port}" in capsys.readouterr().err


def test_a_client_never_listens():
    """A command would open a door on the operator's machine."""
    config, listen = configure(LinkSettings("client"))
    assert listen == ()
    assert config.get_json("mode") == '"client"'
    assert config.get_json("connect/endpoints") == '["tcp/127.0.0.1:7447"]'


def test_a_png_holds_the_very_pixels(tmp_path):
    """A program that measures on the file would measure another loss."""
    still = RequestedStill("uav-1", replace(HEADER, codec="h264-intra"), b"h264", PICTURE)
    still.save(tmp_path / "a.png")
    assert (cv2.imread(str(tmp_path / "a.png")) == PICTURE).all()
    still.save(tmp_path / "a.jpg")
    assert cv2.PSNR(cv2.imread(str(tmp_path / "a.jpg")), PICTURE) > 35
    with pytest.raises(UserError, match="cannot be written"):
        still.save(tmp_path / "none" / "a.png")
