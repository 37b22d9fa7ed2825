"""Where a transport stream may go, and what is refused before the flight."""

import errno
import socket
from pathlib import Path

import av
import av.error
import pytest

from hvt_common.errors import UserError
from hvt_gateways.transport_stream.destination import Address, Datagrams, StreamFile, destination
from programs.small_disk import files_at_most


def test_files_folders_and_urls(tmp_path):
    """What the manual says would be refused."""
    assert destination("flight.ts") == Path("flight.ts")
    assert destination(str(tmp_path)) == tmp_path
    for url in (
        "udp://10.0.0.1:5600",
        "UDP://10.0.0.255:5600",
        "udp://[::1]:5600",
        "udp://{edge}.lan:5600",
        "udp://239.1.1.1:5600?ttl=4",
    ):
        assert destination(url) == Address(url.replace("UDP", "udp"))
    srt = Address("srt://host:8890?streamid=publish:{edge}&passphrase=secret")
    assert srt.of_edge("uav-1").url == "srt://host:8890?streamid=publish:uav-1&passphrase=secret"
    assert (srt.shown, srt.scheme) == ("srt://host:8890", "srt")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("flight.mp4", "flight.mp4 is none of what it may be"),
        ("absent/", "absent/ is none of what it may be"),
        ("http://host:80", "http://host:80 is none of what it may be"),
        ("udp://:5600", "udp://:5600 is none of what it may be"),
        ("udp://host:5600/path", "udp://host:5600/path is none of what it may be"),
        ("udp://me@host:5600", "udp://me@host:5600 is none of what it may be"),
        ("udp://host", "udp://host has no port from 1 to 65535"),
        ("udp://host:0", "udp://host:0 has no port"),
        ("udp://host:70000", "udp://host:70000 has no port"),
        ("udp://host:port", "udp://host:port has no port"),
        ("udp://[::1:5600", "has no port"),
        ("udp://host:5600?ttl=0", "ttl=1 to ttl=255 is"),
        ("udp://host:5600?ttl=x", "ttl=1 to ttl=255 is"),
        ("udp://host:5600?pkt_size=9000", "behind the question mark"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(text, said):
    """A flight would begin, and its stream go nowhere."""
    with pytest.raises(UserError) as refused:
        destination(text)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_srt_is_refused_where_it_is_not_built_in():
    """It would be tried in vain for the whole flight."""
    try:
        av.open("srt://127.0.0.1:9?connect_timeout=1")
    except av.error.ProtocolNotFoundError:
        with pytest.raises(
            UserError, match=r"srt://host:8890 needs SRT, and this PyAV .* give udp://HOST:PORT"
        ):
            destination("srt://host:8890?passphrase=secret")
    except av.error.FFmpegError:
        assert destination("SRT://host:8890") == Address("srt://host:8890")


def test_srt_never_waits_for_ever():
    """By default it does: the ground could not end."""
    assert Address("srt://host:8890").srt_url.startswith("srt://host:8890?connect_timeout=")
    mine = Address("srt://host:8890?mode=listener&listen_timeout=7").srt_url
    assert mine.count("listen_timeout") == 1
    assert "&connect_timeout=" in mine


def test_datagrams_are_of_seven_packets():
    """Larger ones are torn apart on the way, and lost as a whole."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(60)
        datagrams = Datagrams(Address(f"udp://127.0.0.1:{receiver.getsockname()[1]}"))
        assert datagrams.write(bytes(188 * 16)) == 188 * 16
        assert [len(receiver.recv(9000)) for _ in range(3)] == [1316, 1316, 376]
        datagrams.close()
        datagrams.close()


def test_what_the_network_does_not_take_is_said_once(caplog):
    """The log would fill, or the flight end, because a cable is out."""
    datagrams = Datagrams(Address("udp://255.255.255.255:5600"))  # needs a right that nobody asks for
    for _ in range(5):
        assert datagrams.write(bytes(188)) == 188
    datagrams.close()
    assert [one for one in caplog.messages if "does not take all" in one] == caplog.messages
    assert len(caplog.messages) == 1


def test_a_host_that_nobody_knows_is_named():
    """Somebody would search the network for a typing error."""
    with pytest.raises(UserError, match=r"udp://nowhere\.invalid:5600 has no host that can be found"):
        Datagrams(Address("udp://nowhere.invalid:5600"))


def test_a_file_that_is_gone_or_full_is_said(tmp_path):
    """A flight would be written to where nobody finds it."""
    path = tmp_path / "flight.ts"
    file = StreamFile(path)
    assert file.write(b"x" * 188) == 188
    path.unlink()
    with pytest.raises(UserError, match=r"flight.ts cannot be written any further: it was removed"):
        file.write(b"x")
    file.close()
    for full in (StreamFile(Path("/dev/full")), StreamFile(tmp_path / "full.ts")):
        with files_at_most(0), pytest.raises(UserError, match=r"No space left|File too large"):
            full.write(b"x")
        full.close()
    assert Path("/dev/full").exists()
    assert not list(tmp_path.iterdir()), "each try on a full disk would leave one more"
    with pytest.raises(UserError, match="cannot be created"):
        StreamFile(tmp_path / "absent" / "flight.ts")


def test_a_group_without_a_route_names_the_remedy(monkeypatch, caplog):
    """On a laptop in the field, without a gateway, "Network is unreachable" says nothing to whoever reads it."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    stream = Datagrams(Address("udp://239.2.3.1:5600"))
    monkeypatch.setattr("socket.socket.sendto", refuse)
    stream.write(bytes(188))
    stream.close()
    assert "ip route add 224.0.0.0/4 dev INTERFACE" in caplog.text
