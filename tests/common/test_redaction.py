"""Secrets of addresses stay in memory."""

import json
import logging
import sys

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from hvt_common.errors import UserError, exit_with_sentence
from hvt_common.redaction import Redaction, redacted
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.log import start_log

SECRET = "s3cr!t" + "Zq9"
ODD = st.text(st.characters(codec="ascii", categories=["L", "N", "P", "S"]), max_size=6)
PASSWORDS = st.builds(lambda before, after: f"{before}{SECRET}{after}", ODD, ODD)
SCHEMES = st.sampled_from(
    ["rtsp", "rtsps", "http", "rtmp", "srt", "udp", "tcp", "rtp", "RTSP", "rstp", "gopher"]
)
HOSTS = st.sampled_from(["10.0.0.5", "cam", "cam.lan:8554", "[fe80::1]:554", "127.0.0.1:1", "localhost"])
PATHS = st.sampled_from(["", "/", "/cam", "/Streaming/Channels/101", "/a@b", "/live?x=1#y"])


@st.composite
def addresses(draw):
    """An address with a secret in it, at any of the places where cameras have one."""
    scheme, host, path, password = draw(SCHEMES), draw(HOSTS), draw(PATHS), draw(PASSWORDS)
    user = draw(st.sampled_from(["admin:", "", ":", "a@b.c:"]))
    keys = ["password", "pwd", "passphrase", "token", "auth", "streamid", "api_key", "user"]
    key = draw(st.sampled_from(keys))
    return draw(
        st.sampled_from(
            [
                f"{scheme}://{user}{password}@{host}{path}",
                f"{scheme}://{host}{path}?{key}={password}",
                f"{scheme}://{host}/x?channel=1&{key}={password}&subtype=0",
                f"{scheme}://{host}/user=admin&password={password}&channel=1",
                f"{scheme}://{host}/{password}/main",
                f"{scheme}://{host}#{password}",
            ]
        )
    )


def mistyped(address, place, kind):
    """The address with one typing error that leaves the secret whole."""
    begin, end = address.index(SECRET), address.index(SECRET) + len(SECRET)
    place %= len(address)
    # Without a scheme nothing tells the path of a camera, with a word in it, from that of a file.
    assume(kind != "no scheme" or set("@?#=") & set(address))
    assume(not begin <= place < end)
    return {
        "left out": address[:place] + address[place + 1 :],
        "twice": address[: place + 1] + address[place:],
        "space": address[:place] + " " + address[place:],
        "slash": address.replace("://", ":/", 1),
        "no colon": address.replace("://", "//", 1),
        "backslash": address.replace("//", "\\\\", 1),
        "no scheme": address.partition("://")[2],
    }[kind]


TYPOS = st.sampled_from(["left out", "twice", "space", "slash", "no colon", "backslash", "no scheme"])


@given(addresses())
def test_no_secret_of_an_address_is_shown(address):
    """It would stand in the log, in the summary, and at every ground."""
    assert SECRET not in redacted(address)


@given(addresses(), st.integers(0, 200), TYPOS)
def test_nor_of_one_with_a_typing_error(address, place, kind):
    """Who mistypes an address would publish it with the error message."""
    assert SECRET not in redacted(mistyped(address, place, kind))


@given(addresses(), st.sampled_from(["{}", "'{}' is wrong", "[Errno 2] No such file: '{}'", "{} (a b c): x"]))
def test_nor_in_what_libraries_say_of_it(address, words):
    """A library's own error would quote it."""
    hidden = Redaction([address])
    for said in (address, repr(address)[1:-1], json.dumps(address)[1:-1]):
        assert SECRET not in hidden.text(words.format(said))
    if "@" in address.rpartition(SECRET)[2]:
        assert SECRET not in Redaction().text(words.format(address)), "not even of an unknown address"


@example("rtsp", "10.0.0.5", "/{}", "0000c00c")
@example("rtsp", "10.0.0.5", "/cam_{}", "c0000c00")
@given(
    st.sampled_from(["rtsp", "rtsps", "http", "https", "rtmp", "srt", "udp", "tcp", "rtp"]),
    HOSTS,
    st.sampled_from(
        ["/{}", "/live/{}", "/{}/main", "/cam_{}", "/{}.sdp", "/live/{}?x=1", "?{}", "/a?b={}", "#{}"]
    ),
    st.one_of(
        st.text("abcdefghijklmnopqrstuvwxyz", min_size=8, max_size=32),
        st.text("0123456789abcdef", min_size=8, max_size=32),
        st.text("0123456789", min_size=7, max_size=20),
        st.text("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_", min_size=8, max_size=32),
        st.from_regex(r"[a-z0-9]{4}(-[a-z0-9]{4}){2,4}", fullmatch=True),
        st.from_regex(r"[A-Z]{6}[a-z]{3}[A-Z]{3}[0-9]{3}", fullmatch=True),
        st.uuids().map(str),
    ),
)
def test_a_key_in_a_path_is_hidden_whatever_it_is_made_of(scheme, host, form, key):
    """Stream keys are plain letters too; who reads the log would watch the camera."""
    assume(key not in "livemaincam_sdp")
    shown = redacted(f"{scheme}://{host}{form.format(key)}")
    assert key not in shown
    assert shown.startswith(f"{scheme}://{host}")


def test_the_path_of_a_camera_is_shown():
    """Of two cameras of one recorder nobody could tell which it is."""
    for path in (
        *(
            "Streaming/Channels/101",
            "cam/realmonitor",
            "axis-media/media.amp",
            "h264Preview_01_main",
            "live.sdp",
        ),
        *(
            "onvif1",
            "profile2/media.smp",
            "LiveChannel/0/media.smp",
            "video.mjpg",
            "mpeg4/media.amp",
            "videoMain",
        ),
        *("live/ch00_0", "Streaming/tracks/1701", "MediaInput/h264/stream_1", "unicast/c1/s0/live"),
        "hls/index.m3u8",
    ):
        assert redacted(f"rtsp://10.0.0.5/{path}") == f"rtsp://10.0.0.5/{path}"


def test_what_is_left_says_which_camera_it_is():
    """A log of ten cameras would say "…" of each; of one with a typing error nothing is shown."""
    shown = {
        "rtsp://admin:pw@10.0.0.5:554/Streaming/Channels/101": "rtsp://…@10.0.0.5:554/Streaming/Channels/101",
        "http://cam.lan/video.mjpg?token=x": "http://cam.lan/video.mjpg?…",
        "rtsps://10.0.0.1:7441/xKz9Qw2pLmN4vB7c": "rtsps://10.0.0.1:7441/…",
        "rtsps://h/SECRETabcDEF123": "rtsps://h/…",
        "rtsp://10.0.0.5:8554/hunter2": "rtsp://10.0.0.5:8554/…",
        "rtmp://a.example/live2/abcd-efgh": "rtmp://a.example/…/…",
        "rtsp://admin:p#w@10.0.0.5/x": "rtsp://…",
        "admin:pw@10.0.0.5/x": "…",
        **{
            one: one
            for one in ("rtsp://", "udp://239.0.0.1:5000", "/media/2026-01-26T20:57:04Z.mp4", "clip.mp4")
        },
    }
    assert {address: redacted(address) for address in shown} == shown


def test_the_name_of_a_file_may_hold_what_addresses_do():
    """A file that is not there was called "…", so that nobody saw the letter that was wrong in its name."""
    for name in ("clip #2.mp4", "a&b.mp4", "x=1.mp4", "who?.mkv", "me@home.mp4", "day 1/a & b #2.png"):
        assert redacted(name) == Redaction([f"--source={name}", name]).text(name) == name
    line = "source: clip.mp4 stopped (it ended); tcp/127.0.0.1:7447 12:30:05 a=b user@host"
    assert Redaction(["--source", "clip@2x.mp4", "--budget", "800kbps"]).text(line) == line


@pytest.mark.parametrize("form", ["text", "json"])
def test_neither_log_nor_traceback_nor_sentence_has_it(capsys, form):
    """The one line that nobody has thought of would give the camera away."""
    address = f"rtsp://admin:{SECRET}#1[@10.0.0.5/x"

    def run(_words):
        log = start_log("program", quiet=False, form=form, redaction=Redaction([address]))
        log.release()
        logging.getLogger("x").warning("cannot open %s", address)
        failures = Failures(lambda: 0)
        failures.failed("source", f"rtsp://admin:{SECRET}@h/x stopped")
        assert SECRET not in failures.parts[0].reason
        bug = ValueError(f"no port in {SECRET}#1")
        sys.excepthook(type(bug), bug, bug.__traceback__)
        raise UserError(f"source {address!r} is wrong")

    assert exit_with_sentence(run, program="program", argv=["--source", address]) == 2
    said = "".join(capsys.readouterr())
    assert "cannot open" in said
    assert "ValueError" in said
    assert "is wrong" in said
    assert SECRET not in said


def test_an_option_with_several_addresses_hides_no_host():
    """Each line of the log had "…" in place of 127.0.0.1, because a list as text is an address mistyped."""
    redaction = Redaction([["tcp://127.0.0.1:18003", "udp://me:s3cret9@10.0.0.2:1"], ("a",), 5, None])
    assert redaction.text("CoT tcp://127.0.0.1:18003") == "CoT tcp://127.0.0.1:18003"
    assert "s3cret9" not in redaction.text("udp://me:s3cret9@10.0.0.2:1 and s3cret9")


def test_the_values_of_our_own_options_are_no_secrets():
    """Every ``webp`` would be hidden; or a secret in a typing error, or with dashes in it, be shown."""
    words = ["--still-codec=webp", "--encoder=x265", "--source=rtsp://u:Zq9Zq9@cam/x"]
    assert Redaction(words).text("webp x265 Zq9Zq9") == "webp x265 …"
    for word, secret in (
        ("--password=Zq9Zq9", "Zq9Zq9"),
        ("--api-key=Zq9Zq9", "Zq9Zq9"),
        ("--source=rtsp://u:Zq--rate=9@cam/x", "Zq--rate=9"),
    ):
        assert secret not in Redaction([word]).text(f"unrecognized arguments: {word}; {secret}")
