"""The ground flies the same without its extras, and names the one that is missing."""

import re
import time
from contextlib import closing
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import hvt_edge.cli
import hvt_ground
from hvt_archive.exports.tables import LineFile
from hvt_archive.replay.message_log import MessageLog
from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import OnnxDetector, open_detector
from hvt_common.inference.heads import HEAD_NAMES
from hvt_common.inference.store import library_part
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.plug_ins import health_server
from hvt_common.transport.link_doctor import link_doctor
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_edge.source.opening import open_source
from hvt_edge.video.encoder import check_encoder, encoder_names
from hvt_edge.wiring.storing import open_local_copy
from hvt_gateways.mcap.file import McapFile
from hvt_gateways.transport_stream.destination import StreamFile
from hvt_ground.cli import main
from hvt_ground.config import GroundConfig, check
from hvt_ground.extras import all_extras, config_class, locators
from hvt_ground.perception.models import ModelFacts
from hvt_ground.poses import NOWHERE
from hvt_ground.sinks.rerun.recorder import Recorder
from media.onnx_models import colour_classifier, colour_detector
from programs.rrd import settings


@pytest.mark.parametrize(
    ("words", "package"),
    [
        (["--cot", "udp://239.2.3.1:6969"], "cot"),
        (["--mcap=a.mcap"], "mcap"),
        (["--ts", "a.ts"], "ground"),
        (["--terrain", "a.tif"], "terrain"),
        (["--web"], "web"),
        (["--keep", "3days"], "ground"),
        (["--timing", "a.csv"], "ground"),
        (["--serve"], "ground"),
    ],
)
def test_a_setting_of_an_extra_that_is_absent(words, package):
    """It would be an unknown argument, as if there were no such thing."""
    core = config_class(())
    assert check(load(core, [], program="hvt-ground", description="")[0]) == check(core())
    says = f"{words[0].partition('=')[0]} is of an extra that is not installed: pip install 'hvt[{package}]'"
    with pytest.raises(UserError, match=f"^{re.escape(says)}$"):
        load(core, words, program="hvt-ground", description="")


def test_extras_bring_what_the_core_has_not():
    """Two of one name would hide each other."""
    settings = sorted(one for extra in all_extras() for one in vars(extra.options)["__annotations__"])
    known = "cot cot_types keep keep_video log log_size mcap serve stills terrain timing tracks ts view web web_proxy"
    assert settings == known.split()
    assert not set(settings) & set(GroundConfig.__annotations__)
    named = vars(config_class(()))["GONE"]
    assert sorted(named) == known.replace("_", "-").split(), "a core knows what it lacks"


def entry(name: str, where: str = "hvt_nowhere:run") -> dict[str, tuple[EntryPoint]]:
    return {name: (EntryPoint(name, where, "hvt.commands"),)}


NOWHERE_MODULE = "does not load: ModuleNotFoundError: No module named 'hvt_nowhere'"


@pytest.mark.parametrize(
    ("command", "found", "says"),
    [
        *(
            (
                f"hvt-ground {one}",
                {},
                f"hvt-ground {one} is of an extra that is not installed: pip install 'hvt[ground]'",
            )
            for one in ("doctor", "export", "keys", "recordings", "replay", "set-budget", "status")
        ),
        (
            "hvt-edge doctor",
            {},
            "hvt-edge doctor is of an extra that is not installed: pip install 'hvt[edge]'",
        ),
        ("hvt-edge doctor", entry("doctor"), f"command 'doctor' of hvt_nowhere:run {NOWHERE_MODULE}"),
        ("hvt-ground mine", entry("mine"), f"command 'mine' of hvt_nowhere:run {NOWHERE_MODULE}"),
        (
            "hvt-ground mine",
            entry("mine", "json:absent"),
            "command 'mine' of json:absent does not load: AttributeError: module 'json' has no attribute 'absent'",
        ),
    ],
)
def test_a_command_that_is_absent_or_does_not_load(command, found, says, monkeypatch, capsys):
    """A traceback, an unrecognised argument, or advice to install what has nothing to do with it."""
    monkeypatch.setattr("hvt_common.runtime.plug_ins.installed", lambda _group: found)
    program, word = command.split()
    assert {"hvt-edge": hvt_edge.cli.main, "hvt-ground": main}[program]([word]) == 2
    assert capsys.readouterr().err == f"{program}: {says}\n"


def test_a_link_without_its_doctor_is_a_link(monkeypatch, free_port):
    """Who leaves an extra out would have no link, in place of one that nobody explains."""
    monkeypatch.setattr("hvt_common.runtime.plug_ins.installed", lambda _group: {})
    settings = LinkSettings(role="edge", connect=(f"tls/127.0.0.1:{free_port}",), name="uav-1")
    with open_session(settings) as session, link_doctor().watch(session, settings, served=bool) as watch:
        assert (watch.trouble, watch.may_command("uav-1")) == ("", True)
        assert link_doctor().refusals(settings)("uav-1") == ""
    with pytest.raises(UserError, match=r"^--group is of an extra .*: pip install 'hvt\[ground\]'$"):
        check(GroundConfig(group="north"))  # once all was open, and folders lay there


def test_an_option_whose_part_is_of_an_extra_that_is_absent(monkeypatch, tmp_path):
    """An edge would fly without its copy, or be watched by nobody, and say nothing of it."""
    monkeypatch.setattr("hvt_common.runtime.plug_ins.installed", lambda _group: {})
    failures = Failures(time.time_ns)
    with pytest.raises(UserError, match=r"--record-base is of an extra .*: pip install 'hvt\[edge\]'"):
        open_local_copy(tmp_path / "a.mkv", failures=failures, wait=False)
    with pytest.raises(UserError, match=r"--metrics is of an extra .*: pip install 'hvt\[metrics\]'"):
        health_server("edge", "127.0.0.1:1", lambda: None, clock=time.time_ns, stuck_s=1, failures=failures)


def test_an_encoder_of_hardware_without_its_extra_names_it(monkeypatch):
    """It would be an encoder that nobody knows, on the board that has it."""
    brought = encoder_names()[1:]
    assert {"hevc_nvenc", "passthrough"} < {*brought}
    monkeypatch.setattr("hvt_edge.video.encoder.installed", lambda _group: {})
    monkeypatch.setattr("hvt_common.runtime.plug_ins.installed", lambda _group: {})
    for name in brought:
        says = rf"^--encoder {name} is of an extra that is not installed: pip install 'hvt\[edge\]'$"
        with pytest.raises(UserError, match=says):
            check_encoder(name)


@pytest.mark.parametrize(
    ("side", "part"), [("edge", lambda: hvt_edge.open), ("ground", lambda: hvt_ground.listen)]
)
def test_a_side_in_another_program_without_its_extra_names_it(side, part, monkeypatch):
    """Whoever only looked what the package has, or imported the name, met the error of who uses it."""
    for found, says in (
        ({}, f"^hvt_{side}.{part().__name__} is of an extra that is not installed: pip install"),
        (entry(side, "absent_sdk:run"), "^the package 'absent_sdk' is missing: pip install"),
    ):
        monkeypatch.setattr("hvt_common.runtime.plug_ins.installed", lambda _group, found=found: found)
        with pytest.raises(UserError, match=rf"{says} 'hvt\[{side}\]'$"):
            part()(budget="300kbps")


@pytest.mark.parametrize("spec", ["demo", "demo:codes,8k"])
def test_the_drawn_demo_without_its_extra_names_it(spec, monkeypatch):
    """Install hvt whole, it said, to whom pip answers that it is installed."""
    monkeypatch.setattr("hvt_common.runtime.plug_ins.installed", lambda _group: {})
    says = rf"^--source {spec} is of an extra that is not installed: pip install 'hvt\[edge\]'$"
    with pytest.raises(UserError, match=says):
        open_source(spec, size=(640, 360), fps=15)


def test_the_names_of_heads_are_those_that_the_library_reads():
    """A head of ``--help`` would be refused, or one could not be named."""
    assert tuple(library_part("heads") or ()) == HEAD_NAMES


def test_the_embedded_detector_needs_no_library(monkeypatch):
    """A flight with the defaults would need the extra, or its folder of models."""
    monkeypatch.setenv("HVT_MODELS", "~nobody-here/x")
    whole = open_detector("aerial-nano")
    monkeypatch.setattr("hvt_common.inference.store.installed", lambda _group: {})
    monkeypatch.setattr("hvt_common.inference.detect.plug_in_of", lambda _spec, **_taken: None)
    alone = open_detector("aerial-nano")
    assert isinstance(whole, OnnxDetector)
    assert isinstance(alone, OnnxDetector)
    assert (alone.head.name, alone.head.why, alone.pixels) == (whole.head.name, whole.head.why, whole.pixels)


@pytest.mark.parametrize(
    ("detector", "head", "says"),
    [
        (
            "yolox-s",
            None,
            "detector 'yolox-s' is not known: give one of motion, aerial-nano, aerial-cls, or an",
        ),
        ("aerial-nano+motionless", None, "detector 'aerial-nano+motionless' is not available: "),
        ("motion", None, "detector motion is not available: "),
        ("aerial-nano", "yolov8", "head yolov8 is not available: "),
    ],
)
def test_a_model_of_the_library_that_is_absent(detector, head, says, monkeypatch):
    """It would be a model that nobody knows."""
    monkeypatch.setattr("hvt_common.inference.store.installed", lambda _group: {})
    remedy = r"the model library is an extra that is not installed: pip install 'hvt'"
    with pytest.raises(UserError, match=rf"{re.escape(says)}.*{remedy}"):
        open_detector(detector, head=head)


def test_a_detector_that_is_to_read_stills_without_the_library_is_refused_at_the_start(monkeypatch):
    """The first still would end the session of its edge."""
    config = GroundConfig(classifier="detector")
    assert ModelFacts.of(config).redetection is not None
    monkeypatch.setattr("hvt_common.inference.store.installed", lambda _group: {})
    with pytest.raises(UserError, match=r"^--classifier detector is not available: .* pip install 'hvt'$"):
        ModelFacts.of(config)


def test_a_model_whose_pixels_only_the_library_knows_is_not_fed_wrong_ones(monkeypatch, tmp_path):
    """A network that scales its pixels itself got them scaled: dark, and sure of one class."""
    monkeypatch.setattr("hvt_common.inference.store.installed", lambda _group: {})
    said = colour_classifier(tmp_path / "said.onnx", metadata={"hvt.mean": "0", "hvt.scale": "1"})
    assert open_classifier(str(said)).class_names
    for path in (colour_classifier(tmp_path / "c.onnx"), colour_detector(tmp_path / "d.onnx", "yolox")):
        opened = open_detector if path.name == "d.onnx" else open_classifier
        with pytest.raises(
            UserError, match=rf"model {path} is not available: the model library .*pip install"
        ):
            opened(str(path))


def test_without_geolocation_nothing_is_placed_and_a_model_names_its_extra(monkeypatch):
    """A ground without it would not start, or fly with an elevation model that nobody reads."""
    monkeypatch.setattr("hvt_ground.extras.all_extras", tuple)
    assert locators(None)("uav-1") is NOWHERE
    with pytest.raises(UserError, match=r"--terrain is of an extra .*: pip install 'hvt\[terrain\]'"):
        locators(Path("dem.tif"))


@pytest.mark.parametrize(
    "make",
    [
        lambda path: Recorder(settings(path)),
        lambda path: LineFile(path, ["column"]),
        lambda path: MessageLog(path, most_bytes=1_000_000),
        lambda path: McapFile(path, edge="uav-1"),
        StreamFile,
    ],
)
def test_a_file_that_another_ground_writes_is_left_alone(make, tmp_path):
    """Two grounds with one FILE: the second cut the first one's flight down, and both wrote into what was left."""
    path = tmp_path / "flight"
    with closing(make(path)), path.open("ab") as first:
        first.write(b"of the first ground")
        first.flush()
        before = path.read_bytes()
        with pytest.raises(UserError, match="cannot be created: another program is at work on it"):
            make(path)
        assert path.read_bytes() == before
    make(path).close()
