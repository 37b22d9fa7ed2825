"""hvt-edge with input that it cannot use."""

import re
import shlex
from pathlib import Path

import pytest

from media.third_party import PIXELS


@pytest.fixture
def edge(refused, pictures, free_port):
    """Refuse settings on top of a run that would otherwise work."""

    def edge(*settings, source=pictures, code=2):
        link = (
            *("--connect", f"tcp/127.0.0.1:{free_port}", "--wait", "0s", "--size", "96x64"),
            *("--max-frames", "2", "--detector", "motion", "--preset", "ultrafast"),
        )
        return refused("hvt-edge", "--source", source, *link, *settings, code=code)

    return edge


# Where frames come from


def test_no_source(refused):
    """A first try without arguments would show a traceback."""
    sentence = refused("hvt-edge")
    assert "--source" in sentence
    assert "demo" in sentence


def test_a_source_that_is_not_there(edge, here):
    """The user would search for a fault in the camera."""
    Path("loop").symlink_to("loop")
    for source, accepted in (
        *((one, "accepted is") for one in ("nope.mp4", "ftp://host/clip.mp4")),
        *(("/dev/null", "/dev/videoN"), ("loop", "source 'loop' does not exist")),
    ):
        sentence = edge(source=source)
        assert source in sentence
        assert accepted in sentence


# Numbers and words


@pytest.mark.parametrize(
    ("flag", "value", "accepted"),
    [
        # What is no quantity of its kind at all is told apart in tests/common/test_units.py.
        ("size", "abc", "WIDTHxHEIGHT"),
        *(("size", value, "between 64 and 8192") for value in ("641x360", "640x361", "100000x100", "32x32")),
        *(("fps", value, "0.1 to 240") for value in ("0", "nan", "1e9")),
        ("budget", "800 kB", "800kbps"),
        ("video-share", "120%", "0 to 1"),
        *(("padding", value, "0 to 1") for value in ("9", "-0.1")),
        *(("jpeg-quality", value, "5 to 95") for value in ("0", "400", "65.5")),
        *(("detect-every", value, "1 to 1000") for value in ("0", "often")),
        ("max-frames", "0", "from 1"),
        ("cooldown", "1e3", "2s"),
        ("wait", "-1", "2s"),
        *(("source-fps", value, "0.1 to 1000") for value in ("0", "1e6")),
        *(("threads", value, "1 to 64") for value in ("0", "1000")),
        *(("confidence", value, "0.01 to 1") for value in ("0", "2")),
        *(("edge-id", name, "1 to 32") for name in ("UAV_1", "a" * 33, "a/b", "*", "dröne", "a b")),
        ("edge-id", "", "leave it out"),
        *((codec, "gif", "jpeg, h264-intra") for codec in ("still-codec", "fallback-codec")),
        ("tiles", "9x9", "2x2"),
        *((side, "smoke/x:1", "PROTOCOL/HOST:PORT") for side in ("connect", "listen")),
        ("zenoh-config", "missing.json5", "JSON5"),
        ("method", "M9", "M0, M1, M2, M3, M4, M5, M6, R0, permissive"),
        ("method", "m5", "M5"),
        ("regime", "high", "low, moderate"),
        ("preset", "placebo", "ultrafast"),
        ("encoder", "x266", "x265, hevc_nvenc, hevc_qsv, hevc_v4l2m2m, passthrough"),
        ("pace", "fast", "realtime, lockstep"),
        ("fit", "stretch", "letterbox, crop"),
        ("candidates", "both", "choose one of"),
        ("camera-motion", "gps", "choose one of"),
        ("seed", "-1", "whole number from"),
        ("keyframe-interval", "9e400", "is not a duration"),
    ],
)
def test_a_value_that_is_not_accepted(edge, flag, value, accepted):
    """The user would have to read the source to learn what the setting takes."""
    sentence = edge(f"--{flag}", value)
    assert re.search(rf"--{flag}[ :]", sentence)
    assert value in sentence
    assert accepted in sentence


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--video-share 0", ["--video-share 0 leaves no base stream"]),
        ("--size 1280x720 --budget 10kbps", ["--budget 10 kbps", "at least", "--size"]),
        ("--size 1280x720 --budget 300", ["--budget 0.3 kbps is too little"]),
        *(
            (f"--encoder hevc_nvenc {regions}", ["--roi-depth 0.1 needs x265", "--encoder hevc_nvenc"])
            for regions in ("--roi-depth 0.1", "--method R0")
        ),
        ("--method M5 --size 1280x720 --budget 60kbps", ["give at least 117 kbps, lower --size or --fps"]),
        ("--method M5 --size 1280x720 --budget 500kbps --video-share 0.1", ["or raise --video-share 0.1"]),
        ("--video-share 1e-320", ["leaves no base stream: give 0.01 to 1"]),
        *(
            (f"--regime low {more}", ["--regime low already sets"])
            for more in ("--budget 1Mbps", "--video-share 0.5")
        ),
        ("--config=--", ["--config [] is not accepted"]),
        *(
            (f"--window {window}", [f"--window {said} is not accepted"])
            for window, said in (("0s", "0s"), ("10ms", "0.01s"), ("61s", "61s"))
        ),
        *((words, [words.split()[0], "--help"]) for words in ("--bogus", "stray", "--budgit 1M", "--bud 1M")),
        ("--budget", ["--budget"]),
        ("--pose pictures", ["--pose pictures", "accepted is FILE.csv"]),
        ("--pose fixed:1,2,3", ["--pose fixed:1,2,3", "fixed:LAT,LON,HEIGHT,AZIMUTH,TILT"]),
        ("--truth truth.txt --summary s.json --record-base b.mkv", ["--truth truth.txt", "demo"]),
        ("--zenoh-config pictures", ["--zenoh-config pictures"]),
        *((f"--listen tcp/{host}:7999", [host, "--insecure"]) for host in ("0.0.0.0", "[::]")),
    ],
)
def test_words_that_cannot_be_meant_so(edge, words, told):
    """What was asked for would silently not count, or never work; a typing error would open a door to all."""
    sentence = edge(*shlex.split(words))
    assert [one for one in told if one not in sentence] == []


# Files


@pytest.mark.parametrize("flag", ["--summary", "--record-base", "--truth"])
@pytest.mark.parametrize("path", ["missing/file", "pictures", "/proc/file"])
def test_a_file_that_cannot_be_written(edge, flag, path):
    """The run would end before its result could be kept."""
    # A folder that is missing may be of a disk that is mounted later: a supervisor starts the edge again.
    assert f"{flag} {path}" in edge(flag, path, code=1 if path.startswith("missing/") else 2)


@pytest.mark.parametrize(
    ("flag", "file"), [("--detector", "m.onnx"), ("--detector", "m.xml"), ("--pose", "p.csv")]
)
def test_an_input_of_a_disk_that_is_not_mounted_yet_is_tried_again(edge, flag, file):
    """A supervisor would never start the edge again once the disk with its model is there."""
    assert f"missing/{file}" in edge(flag, f"missing/{file}", code=1)
    assert file in edge(flag, file)


@pytest.mark.parametrize("flag", ["--summary", "--record-base", "--truth"])
@pytest.mark.parametrize("what", ["--source", "--detector", "--pose", "--zenoh-config"])
def test_an_output_over_what_is_read(edge, here, flag, what):
    """The only copy of a clip would be the summary of its first flight."""
    Path("read").write_text("by the edge")
    Path("out.mkv").hardlink_to("read")
    assert f"{flag} out.mkv is read itself" in edge(flag, "out.mkv", what, "read")
    assert Path("read").read_text() == "by the edge"


@pytest.mark.parametrize("name", ["0.png", "2.JPG", "../pictures/1.png"])
def test_an_output_among_the_pictures_of_the_source(edge, pictures, name):
    """A picture of the flight would be its summary, or the next flight show one that is none."""
    before = [(one.name, one.read_bytes()) for one in sorted(Path(pictures).iterdir())]
    said = edge("--summary", f"{pictures}/{name}")
    assert f"--summary {pictures}/{name} would be a picture of --source pictures" in said
    assert [(one.name, one.read_bytes()) for one in sorted(Path(pictures).iterdir())] == before


def test_two_outputs_of_one_file_and_an_old_summary(edge, here):
    """The summary would overwrite the recording; a failed start lose yesterday's summary."""
    said = edge("--record-base", "one.mkv", "--summary", "./one.mkv")
    assert "--summary and --record-base both name one.mkv: give each a file of its own" in said
    Path("s.json").write_text("yesterday")
    edge("--summary", "s.json", "--record-base", "b.mkv", "--listen", "tcp/0.0.0.0:7999")
    assert Path("s.json").read_text() == "yesterday"


def test_files_of_settings_that_are_wrong(edge, here):
    """A drone would start with other settings than those in its file, or a link without its keys.

    What is wrong in a file is told apart in tests/common/test_config.py and transport/test_session.py.
    """
    Path("edge.toml").write_text('edge-id = "UAV_1"\n')
    assert "edge-id in edge.toml 'UAV_1' is not usable" in edge("--config", "edge.toml")
    assert "--config pictures" in edge("--config", "pictures")
    Path("zenoh.json5").write_text("{ mode: ")
    assert "zenoh.json5:1 is not JSON5" in edge("--zenoh-config", "zenoh.json5")


def test_a_still_codec_that_does_not_work_here(edge, packages):
    """The first still of the flight would find out that its library is another build."""
    broken = PIXELS.replace("step = 65 -", 'raise RuntimeError("another build")\n        step = 65 -')
    packages({"acme-pixels": "PixelCodec"}, source=broken)
    said = edge("--still-codec", "acme-pixels")
    assert "--still-codec acme-pixels does not work here (another build)" in said
