"""Hides the secrets of addresses: all text that is printed, logged, written or sent goes through here. Pure.

Of an address scheme, host and port are shown, and the words of its path that cameras use. A password, a token or a
stream key may stand in its user, its query, its path or its fragment, and may look like any other word; an address
with a typing error has them anywhere.
"""

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any
from urllib.parse import quote, unquote

HIDDEN = "…"

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]{0,15}):[/\\]+", re.ASCII)
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]*(?:%\w{1,16})?\]|[\w*-]+(?:\.[\w*-]+)*)(?::(\d{1,5}))?", re.ASCII)
_FILE = re.compile(
    r"[^@?&=#:\\]*|[^@?&=#\\]*\d:\d[^@?&=#\\]*|[^/:\\]*\.[A-Za-z]\w{1,3}|[^@?:\\]*\.[A-Za-z]\w{1,3}", re.ASCII
)
"""Text that may be the name of a file: a colon stands between the digits of a time alone, and the signs of an address
in a name with an ending alone."""
_SCHEMELESS = re.compile(
    r"\s*(?:(?:rtsps?|rtmps?|https?|srt|udp|tcp|rtp)\b[:/\\]|\w*//|[^/]*:\d+/|(?:\d{1,3}\.){3}\d)|.*:[/\\]",
    re.IGNORECASE | re.DOTALL,
)
"""Text that looks like an address with a typing error, and like no file."""
_STREAM_WORDS = """
amp api asf bin av avi avc axis axis-media c cam camera cameras cgi ch clip clips channel channels cif default
dev drone feed file flv h hd hevc high hls image img index input ipcam ir isapi jpeg jpg live livechannel
livestream low m main media mediainput mjpeg mjpg mkv mov mp mpeg multicast mxpeg onvif play preview profile
psia ptz realmonitor rgb rtp rtpvideo rtsp s sav sd sdp sensor smp snapshot src stream streaming streams sub
test thermal third track tracks ts u uav udp unicast v vga video videoinput videomain videosub visible vod
webm wide x zoom
"""
"""Words in the paths that cameras, gimbals and media servers give their streams."""
_MOST_DIGITS, _MOST_DIGITS_TOGETHER = 6, 4
_PLAIN = re.compile(r"[A-Z]?[a-z]{0,12}[0-9]{0,4}", re.ASCII)
"""A word that is hidden in its address alone, as it may stand anywhere else, such as in the name of an edge."""
_SEPARATOR = re.compile(r"[/?#\\]")
_HOSTLIKE = r"(?:\[|localhost|(?:\d{1,3}\.){3}\d|[^/]*:\d)"
_BEGIN = re.compile(
    rf"://+|:\\+|\b(?:rtsps?|rtmps?|https?|srt|udp|tcp|rtp):/|\w:/(?=[^/]*@|{_HOSTLIKE})|[\w\s]//",
    re.IGNORECASE,
)
_LIKELY = re.compile(rf":.*@|[#?]|@{_HOSTLIKE}|(?:^|=){_HOSTLIKE}[^/]*/")
"""Signs of an address without a scheme; ``clip@2x.mp4`` is none."""
_MOST_PORT = 65535

_KEY = r"[\w.-]{0,32}(?:pass|pwd|pw|key|token|auth|secret|sig|user|cred|streamid|session|code)[\w.-]{0,32}"
_PAIR = re.compile(rf"(?<![\w.-])({_KEY})=([^&\s\"'<>)\],;…]+)", re.IGNORECASE)
_OPTION = re.compile(r"^--(?![a-z-]*(?:pass|pwd|pw|token|auth|secret|cred|key=))[a-z-]+=")
"""``--still-codec=webp`` is no pair: every ``webp`` in log and summary would be hidden. One for a secret is a typing
error, and none of ours."""
_LEAST = 3
"""A secret of fewer characters would blot out half of every sentence; in an address it is hidden all the same."""
_ANYWHERE = re.compile(r"([A-Za-z][A-Za-z0-9+.-]{0,15}:[/\\]{1,4})(?:[^\n]*@|[^\s\"'@]*@)")


def redacted(address: str) -> str:
    """An address as it may be shown, such as ``rtsp://…@10.0.0.5/stream1?…``; the path of a file stays as it is.

    Where the host cannot be told from the rest, as with a ``#`` in a password, nothing but the scheme is shown.
    """
    found = _SCHEME.match(address)
    if found is None:
        if _SCHEMELESS.match(address) or not _FILE.fullmatch(address):
            return HIDDEN
        return address
    scheme, body = found[0], address[found.end() :]
    if _SEPARATOR.search(scheme.removesuffix("//").rstrip(":")) or not scheme.endswith("://"):
        return f"{found[1]}:{HIDDEN}"
    end = _SEPARATOR.search(body)
    authority, rest = (body, "") if end is None else (body[: end.start()], body[end.start() :])
    _, at, host = authority.rpartition("@")
    good = _HOST.fullmatch(host)
    # An @ in the rest: a password with a slash, or a path with an @.
    if "@" in rest or good is None or int(good[2] or 0) > _MOST_PORT:
        return f"{scheme}{body and HIDDEN}"
    if good[2] and not at and "." not in good[1] and good[1] not in ("localhost", "") and good[1][0] != "[":
        host = f"{good[1]}:{HIDDEN}"  # admin:12345 with the host left out
    return (
        f"{scheme}{f'{HIDDEN}@' if at else ''}{host}{_path(rest, hidden=found[1].lower().startswith('rtmp'))}"
    )


def _path(rest: str, *, hidden: bool) -> str:
    # The part of a path that may be shown: words as cameras name their streams. RTMP has a stream key there.
    path = re.split(r"[?#\\]", rest, maxsplit=1)[0]
    parts = (part if not hidden and _is_usual(part) else part and HIDDEN for part in path.split("/"))
    return "/".join(parts) + (f"?{HIDDEN}" if path != rest else "")


def _is_usual(part: str) -> bool:
    # Whether a part of a path has nothing but the words and short numbers of cameras: ``h264Preview_01_main``. Many
    # digits with lone letters between may be a key in base 16.
    runs = re.findall(r"[A-Za-z]+|[0-9]+|.", part, re.DOTALL)
    numbers, usual = [one for one in runs if one.isdigit()], _STREAM_WORDS.split()
    lone = sum(len(one) == 1 and one.isalpha() for one in runs)
    return (
        sum(map(len, numbers)) <= (_MOST_DIGITS if lone < 2 else _MOST_DIGITS_TOGETHER)
        and max(map(len, numbers), default=0) <= _MOST_DIGITS_TOGETHER
        and all(one in "._-" or one.isdigit() or one.lower() in usual for one in runs)
    )


class Redaction:
    """Hides the secrets of a process's ``addresses`` in any text, however a library has quoted them.

    Of settings with several values, as lists or tuples, each value is an address; other values are read as text.
    """

    def __init__(self, addresses: Iterable[object] = ()) -> None:
        several = (one if isinstance(one, list | tuple) else (one,) for one in addresses)
        words = [str(one) for values in several for one in values]
        self._whole = {
            spelt: redacted(one) for one in words if _BEGIN.search(one) for spelt in _spellings(one)
        }
        found = {one for word in words for one in _secrets(word)}
        variants = {spelt for one in found for spelt in _spellings(one)}
        self._literal = sorted((one for one in variants if len(one) >= _LEAST), key=len, reverse=True)

    def text(self, text: str) -> str:
        """The text without them, and without the user of any other address, or a ``password=…`` in one."""
        for whole, shown in self._whole.items():
            text = text.replace(whole, shown)
        for one in self._literal:
            text = text.replace(one, HIDDEN)
        if "://" in text or ":/" in text:
            text = _ANYWHERE.sub(lambda found: f"{found[1]}{HIDDEN}@", text)
            text = _PAIR.sub(lambda found: f"{found[1]}={HIDDEN}", text)
        return text

    def value(self, value: Any) -> Any:
        """The same for each text within lists and tables; other values stay as they are."""
        if isinstance(value, str):
            return self.text(value)
        if isinstance(value, Mapping):
            return {key: self.value(one) for key, one in value.items()}
        return [self.value(one) for one in value] if isinstance(value, list | tuple) else value


def _secrets(word: str) -> Iterable[str]:
    # The secret parts of a word, an address or ``--source=`` and one; of a typing error rather too much.
    word = _OPTION.sub("", word)
    found = _BEGIN.search(word)
    if found is None and not _LIKELY.search(word) and not _PAIR.search(word):
        return
    body = word if found is None else word[found.end() :]
    user, at, _ = body.rpartition("@")
    if at:
        name, colon, password = user.partition(":")
        yield from (user, password if colon else name)
    yield from (value for _, value in _PAIR.findall(body))
    # A library may split the address at any of these; the shown parts need not be hidden.
    shown = redacted(word)
    for part in re.split(r"[/?#&;@\[\]\\]", body):
        for one in (part, *part.split("=", 1)[1:], *part.split(":")):
            if one not in shown and (at or not _PLAIN.fullmatch(one)):
                yield one


def _spellings(secret: str) -> Iterable[str]:
    plain = unquote(secret)
    for one in (secret, plain, quote(plain, safe=""), quote(plain)):
        yield one
        yield repr(one)[1:-1]
        yield json.dumps(one)[1:-1]
        yield json.dumps(one, ensure_ascii=False)[1:-1]
