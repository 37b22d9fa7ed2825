"""Mutations of a still that leave its outside whole: a header that is refused keeps the decoder behind it untried."""

from collections.abc import Callable
from random import Random

from hvt_codecs.avif import av1_data, av1_size, avif_file
from hvt_common.video.still_codecs import StillError
from lab.fuzz.mutate import Bytes, Mutator

_Change = Callable[[bytes, Random, Bytes], bytes]


def inside(name: str) -> Mutator:
    """A mutator of the payload behind the first byte, which says the size; now and then of any byte at all."""
    change = _CHANGES.get(name)

    def mutated(data: bytes, rng: Random, raw: Bytes) -> bytes:
        if change is None or len(data) < 2 or rng.random() < 0.15:
            return raw(data)
        try:
            return data[:1] + change(data[1:], rng, raw)
        except (StillError, ValueError, IndexError):
            return raw(data)

    return mutated


def _jpeg(data: bytes, rng: Random, raw: Bytes) -> bytes:
    """Tables in front of the frame header, the scan's header, or the scan."""
    frame, scan = data.index(b"\xff\xc0"), data.index(b"\xff\xda")
    dice = rng.random()
    if dice < 0.2:
        return data[:2] + raw(data[2:frame]) + data[frame:]
    if dice < 0.35:
        return data[: frame + 10] + raw(data[frame + 10 : scan]) + data[scan:]
    body = raw(data[scan + 14 : -2]).replace(b"\xff", b"\xff\x00")
    return data[: scan + 14] + body + b"\xff\xd9"


def _webp(data: bytes, rng: Random, raw: Bytes) -> bytes:
    body = raw(data[30:])
    body = body[:65_000]
    chunk = data[20:30] + body
    if len(chunk) % 2:
        chunk += b"\0"
    whole = b"WEBPVP8 " + len(chunk).to_bytes(4, "little") + chunk
    return b"RIFF" + len(whole).to_bytes(4, "little") + whole


def _av1(data: bytes, rng: Random, raw: Bytes) -> bytes:
    """The rest of the sequence header, or the frame."""
    length = data[1]
    sequence, rest = data[2 : 2 + length], data[2 + length :]
    start = 2 if rest[1] < 0x80 else 3
    frame = rest[start:]
    if rng.random() < 0.3:
        sequence = sequence[:6] + raw(sequence[6:])[:100]
    else:
        frame = raw(frame)
    return b"\x0a" + bytes([len(sequence)]) + sequence + b"\x32" + _leb128(len(frame)) + frame


def _avif(data: bytes, rng: Random, raw: Bytes) -> bytes:
    av1 = av1_data(data)
    return avif_file(_av1(av1, rng, raw), size=av1_size(av1))


def _leb128(number: int) -> bytes:
    return bytes([number & 0x7F | 0x80, number >> 7]) if number > 0x7F else bytes([number])


def _jxl(data: bytes, rng: Random, raw: Bytes) -> bytes:
    length = rng.choice((10, 12, 16, 24))
    return data[:length] + raw(data[length:])


_CHANGES: dict[str, _Change] = {
    "jpeg": _jpeg,
    "webp": _webp,
    "avif": _avif,
    "jxl": _jxl,
}
