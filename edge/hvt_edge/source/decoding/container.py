"""Opens files and streams through PyAV, and reads the usable part of damaged ones."""

from __future__ import annotations

import logging
import math
import os
import re
import time
import weakref
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import av.error
from av.stream import Disposition

from hvt_common.errors import NotYetError, UserError
from hvt_common.redaction import redacted
from hvt_edge.source.decoding.timeline import LONG_PAUSE_S, LONG_STEP_S, Stamps, surveyed

_log = logging.getLogger(__name__)

_TEXT_CODECS = frozenset({"ansi", "bintext", "xbin", "idf"})
"""FFmpeg plays text files as a terminal's screen; no user means that."""
_PICTURE_CODECS = frozenset({"mjpeg", "png", "bmp", "gif", "tiff", "webp", "jpegxl"})
_HEIF_BRANDS = frozenset({"heic", "heix", "heim", "heis", "mif1"})
"""A phone's photograph is made of tiles, of which each is a stream to PyAV."""
_NO_FILM = Disposition.attached_pic | Disposition.still_image | Disposition.timed_thumbnails
_OPEN_S, _READ_S = 10.0, 10.0
_THREAD_PX, _THREAD_FPS = 1280 * 720, 30
"""The load that one thread decodes beside its other work: 9 ms a picture of H.264 at 8 Mbit/s."""
_NO_STAMPS = 0x80
"""``AVFMT_NOTIMESTAMPS`` of libavformat: a raw stream, whose times FFmpeg invents at 25 frames a second."""
_PICTURES_IN_A_ROW = "_pipe"
"""The ending of the names of picture formats (``jpeg_pipe``), whose times FFmpeg invents too."""
_MAY_JUMP = 0x200
"""``AVFMT_TS_DISCONT``: a container whose stamps may jump by design."""
_MOST_FPS = 240
"""A stream with a higher rate reports its clock there, or was given no rate: 500, 90000."""
_SURVEYED = 256
"""Packets at the start of a clip whose stamps are surveyed."""
QUIET_S, _POLL_S = 10.0, 0.1
"""A file that has not grown for this long has ended."""
_MOST_BOXES = 2**16
"""Nine hours of fragments, a second each."""
_MOST_ZEROS = 2**24
"""Bytes behind the last box that are looked at."""
DEMUX_OPTIONS = {"merge_pmt_versions": "1"}
"""A sender of MPEG-TS that begins anew may number its film otherwise: it is the same film to a viewer."""
_FILE_OPTIONS = {
    **DEMUX_OPTIONS,
    # An HLS playlist whose recorder has ended is read from its beginning, and polled thrice for more.
    "live_start_index": "0",
    "m3u8_hold_counters": "3",
    # Else FFmpeg asks on a line that most servers have closed, and leaves out the frame that it wanted there.
    "multiple_requests": "1",
}
_PLAYLIST, _IN_SEGMENTS = ".m3u8", "hls"
_WITHOUT_INDEX, _MOST_BEHIND = frozenset({"mpegts", "flv"}), 0.2
"""Formats that end with their last picture; a larger part behind it is another recording, or sound alone."""
_MOST_DAMAGED, _MOST_DAMAGED_S = 8, 2.0
"""JPEGs in a row, and seconds from the first of them: of a longer row each is shown."""
_TS_BYTES = (188, 192, 204)
"""Size of a packet: plain, with a time before it as in Blu-ray's, with a checksum behind it as in DVB's."""


def is_local(spec: str) -> bool:
    """Whether it is a path. An existing path is one, whatever its name looks like."""
    with suppress(OSError, ValueError):
        return "://" not in spec or Path(spec).exists()
    return "://" not in spec


def name_of(spec: str) -> str:
    """The name as it may be printed; `is_local` paths are printed whole."""
    return spec if is_local(spec) else redacted(spec)


class _GrowingFile:
    # A file that is still written: a read at its end waits for more.

    def __init__(self, path: str) -> None:
        self._file = os.open(path, os.O_RDONLY)
        self._ended = False
        weakref.finalize(self, os.close, self._file)  # PyAV drops it without closing it

    def read(self, size: int) -> bytes:
        """At most ``size`` bytes; none, also in later calls, once it has not grown for ten seconds."""
        until_s = time.monotonic() + QUIET_S
        while not (data := os.read(self._file, size)) and not self._ended:
            if time.monotonic() >= until_s:
                self._ended = True
            else:
                time.sleep(_POLL_S)
        return data


def open_video(
    spec: str, *, growing: bool = False, note: Callable[[str], None] = lambda _: None
) -> tuple[Any, Any]:
    """Open a file or a URL, and the stream that is its film. ``note`` receives the choice, where there are several.

    With ``growing`` a file is read while it grows. Raises `UserError` where there is no film, `NotYetError` where
    a growing file is too short so far.
    """
    name, local = name_of(spec), is_local(spec)
    refusal = NotYetError if local and growing else UserError
    try:
        if local and Path(spec).stat().st_size == 0 and not growing:
            raise UserError(f"source {spec!r} is an empty file; accepted is a video file")
        # By its own name a file may look like an address.
        where: Any = f"file:{spec}" if local else spec
        file, options = where, _FILE_OPTIONS
        if local and growing and spec.endswith(_PLAYLIST):  # FFmpeg polls for more itself
            options = {**options, "m3u8_hold_counters": "1000"}
        elif local and growing:
            file = _GrowingFile(spec)
        try:
            container = av.open(file, options=options, timeout=(_OPEN_S, _READ_S))
        except (av.error.InvalidDataError, av.error.EOFError):
            if local:
                raise
            # A server of one line at a time does not answer on a second one while the first is open.
            container = av.open(
                file, options={**options, "multiple_requests": "0"}, timeout=(_OPEN_S, _READ_S)
            )
    except (av.error.FFmpegError, OSError, ValueError) as error:
        unfinished = _lacks_index(Path(spec)) if local else ""
        raise refusal(
            f"source {name!r} is {unfinished}"
            if unfinished
            else f"source {name!r} is not a video that can be read ({cause_of(error)}); accepted is any video file "
            "that FFmpeg decodes"
        ) from None
    is_heif = container.metadata.get("major_brand") in _HEIF_BRANDS
    stream = None if is_heif else choose_stream(container, note=note)
    if stream is None:
        container.close()
        holds = "is a HEIC picture: convert it to JPEG" if is_heif else "holds no video"
        raise refusal(f"source {name!r} {holds}; accepted is any video file that FFmpeg decodes")
    stream.thread_type = "AUTO"
    codec = stream.codec_context
    # Each thread decodes a picture of its own, and holds it and its reference pictures.
    quick = max(1.0, float(said_rate(stream) or 0) / _THREAD_FPS)
    threads = math.ceil(codec.width * codec.height * quick / _THREAD_PX)
    codec.thread_count = max(1, min(threads, os.cpu_count() or 1))
    return container, stream


def choose_stream(container: Any, *, note: Callable[[str], None] = lambda _: None) -> Any | None:
    """The film: no cover picture, the one marked as default, then the largest. None where there is no video.

    ``note`` receives the choice, where there are several.
    """
    able = [one for one in container.streams.video if one.codec_context is not None]
    able = [one for one in able if one.codec_context.name not in _TEXT_CODECS]
    films = [one for one in able if not one.disposition & _NO_FILM and one.frames != 1] or able
    if not films:
        return None
    best = container.streams.best("video")

    def rank(stream: Any) -> tuple[bool, int, bool, int]:
        codec = stream.codec_context
        is_default = bool(stream.disposition & Disposition.default)
        return is_default, codec.width * codec.height, stream is best, -stream.index

    if films[0].disposition & Disposition.attached_pic:
        note("it holds no film: what is shown is its cover picture")
    moving = [one for one in films if one.codec_context.name not in _PICTURE_CODECS] or films
    chosen = max(moving, key=rank)
    if is_picture_each(chosen):
        chosen.codec_context.options = {"err_detect": "explode"}
    if len(able) > 1:
        codec = chosen.codec_context
        note(
            f"of its {len(able)} video streams number {chosen.index} is the film "
            f"({codec.name}, {codec.width}x{codec.height}): no cover picture, then the default, then the largest"
        )
    return chosen


def without_stamps(stream: Any) -> bool:
    container = stream.container.format
    return bool(container.flags & _NO_STAMPS) or container.name.endswith(_PICTURES_IN_A_ROW)


def said_rate(stream: Any) -> Fraction | None:
    """Frames a second by the container, or by the stream itself where the container invents them; else None."""
    if without_stamps(stream):
        rate = stream.codec_context.framerate
    else:
        rate = stream.average_rate or stream.guessed_rate or stream.base_rate
    return Fraction(rate) if rate and rate <= _MOST_FPS else None


def about_times(stream: Any, stamps: Stamps) -> str:
    """A guess at the frames' times, or what is odd about them, in a sentence; empty for nothing."""
    fps = float(1 / stamps.period_s)
    if not stamps.usable:
        why = "it has no time stamps" if without_stamps(stream) else "its time stamps do not rise"
        said = "as the stream itself says" if said_rate(stream) else "which is a guess"
        return f"{why}: {fps:.4g} frames a second, {said}; --source-fps N says another rate"
    if fps > _MOST_FPS:
        return (
            f"it says {fps:.6g} frames a second, of which most are left out; --source-fps N says another rate"
        )
    if stream.container.format.name == "avi" and stream.codec_context.has_b_frames:
        return "AVI has time stamps of the decoding alone: the n-th frame of the film is shown at the n-th of them"
    return ""


def duration_s(stream: Any) -> Fraction | None:
    """The film's duration by the container; None where it has none.

    Matroska stores the end instead: a recording that continues an earlier one does not begin at 0.
    """
    if stream.duration:
        return _seconds(stream.duration, stream.time_base)
    whole_s = _seconds(stream.container.duration, Fraction(1, 1_000_000))
    begin_s = _seconds(stream.start_time, stream.time_base) or Fraction(0)
    if not whole_s or "matroska" not in stream.container.format.name:
        return whole_s or None
    return whole_s - begin_s if 0 < begin_s < whole_s else whole_s


def survey(container: Any, stream: Any, *, name: str) -> tuple[Stamps, av.VideoFrame]:
    """The times in the stream's first packets, and its first frame. Raises `UserError` where none decodes there."""
    times: list[tuple[Fraction | None, Fraction | None]] = []
    first: av.VideoFrame | None = None
    patched: av.VideoFrame | None = None
    why, decoder = "", Decoder(stream)
    for packet in packets_of(container, stream):
        if first is None:
            with suppress(av.error.FFmpegError):
                first = next(iter(decoder.decode(packet)), None)
        if first is None and patched is None and is_picture_each(stream):
            with suppress(av.error.FFmpegError):
                patched = next(iter(Decoder(stream, whole=False).decode(packet)), None)
        if isinstance(packet, Exception):
            why = f" ({cause_of(packet)})"
            if "://" in name and "mp4" in container.format.name:
                why += (
                    ": a server without HTTP ranges plays an MP4 whose index (moov) comes first (+faststart)"
                )
        elif packet.size:
            base = packet.time_base
            times.append((_seconds(packet.pts, base), _seconds(packet.dts, base)))
        if len(times) >= _SURVEYED and first is not None:
            break
    whole = first is not None and not decoder.patched
    first = first if whole else patched or first
    if first is None:
        raise UserError(f"source {name!r} holds a video stream of which no frame can be decoded{why}")
    rate = said_rate(stream)
    if without_stamps(stream):
        return Stamps(1 / (rate or Fraction(25)), usable=False, whole=whole), first
    reorders = bool(stream.codec_context.has_b_frames)
    stamps = surveyed(times, said_fps=rate, reorders=reorders)
    long_s = LONG_STEP_S if container.format.flags & _MAY_JUMP else LONG_PAUSE_S
    # AVI's presentation stamps are FFmpeg's guess, wrong where frames were dropped, or two lie in a packet.
    return replace(
        stamps, ordered=stamps.ordered and container.format.name != "avi", long_s=long_s, whole=whole
    ), first


def decoded(
    container: Any, stream: Any, *, name: str, stamps: Stamps
) -> Generator[tuple[Fraction, av.VideoFrame], None, None]:
    """Every frame that decodes with its time in seconds, in presentation order.

    Damage is skipped and reported once, at the end; a jump of the time stamps is mended and reported when it comes.
    """
    timeline = stamps.timeline(stream)
    reading = _Reading(container, stream, whole=stamps.whole)
    before_s: Fraction | None = None
    lost, each_is_one = 0, is_picture_each(stream)
    segments = container.format.name == _IN_SEGMENTS
    longest_s = max(Fraction(1 if segments else LONG_STEP_S), 3 * stamps.period_s)
    for frame in reading.frames():
        if each_is_one and not stamps.usable:
            for _ in range(reading.damaged - lost):
                timeline.at(None)  # or all that follows would come too early
        lost = reading.damaged
        stamp = frame.pts if stamps.ordered else frame.dts
        jumped = bool(timeline.jumps)
        at_s = timeline.at(_seconds(stamp, frame.time_base) if stamps.usable else None)
        if before_s is not None and at_s - before_s > longest_s:
            longest_s = at_s - before_s
            pause = f"{float(longest_s):.1f} s at {float(before_s):.1f} s"
            why = "as its time stamps say" + ", or a segment is missing" * segments
            _log.warning("%s: its picture stands for %s, %s", name, pause, why)
        before_s = at_s
        yield at_s, frame
        if timeline.jumps and not jumped:
            _log.warning("%s: %s", name, timeline.says)
    if len(timeline.jumps) > 1:
        _log.warning("%s: its time stamps jumped %d times in all", name, len(timeline.jumps))
    if timeline.jumps and before_s is not None:
        reading.ahead_s = sum((step_s for _, step_s in timeline.jumps if step_s > 0), Fraction(0))
        reading.end_s = before_s + stamps.period_s
    for sentence in reading.faults():
        _log.warning("%s %s", name, sentence)


class _Reading:
    def __init__(self, container: Any, stream: Any, *, whole: bool) -> None:
        self._container, self._stream, self._decoder = container, stream, Decoder(stream, whole=whole)
        self._size = _size_of(container)
        self._begin_s = _seconds(stream.start_time, stream.time_base) or Fraction(0)  # guessed later
        self.damaged = self._count = self._lossy = 0
        self._ended = ""
        self.end_s: Fraction | None = None
        """End of the film by its time stamps, as far as these go on."""
        self.ahead_s = Fraction(0)
        """Steps ahead within it that were mended."""
        self._end_byte = 0

    def frames(self) -> Iterator[av.VideoFrame]:
        for packet in packets_of(self._container, self._stream):
            if isinstance(packet, Exception):
                self._ended = f"it breaks off ({cause_of(packet)})"
            else:
                self._count += bool(packet.size)  # frames that an edit list hides are there too
                self._lossy += packet.is_corrupt and self._container.format.name == "mpegts"
                self._end_byte = max(self._end_byte, (packet.pos or 0) + packet.size)
                # By presentation time: in decoding order, the last B-frame lies whole frames before the end.
                stamp = packet.dts if packet.pts is None else packet.pts
                if stamp is not None:
                    end_s = Fraction(stamp + (packet.duration or 0)) * (packet.time_base or 0)
                    self.end_s = max(end_s, self.end_s or end_s)
            try:
                frames = self._decoder.decode(packet)
            except av.error.FFmpegError:
                self.damaged += 1
                continue
            yield from frames

    def faults(self) -> Iterator[str]:
        if self.damaged:
            codec = self._stream.codec_context.name
            yield f"has {self.damaged} packets, damaged or of another codec than {codec}, which were skipped"
        if self._decoder.patched:
            yield f"has {self._decoder.patched} damaged pictures, shown as the decoder has patched them"
        if self._lossy:
            yield f"lacks packets at {self._lossy} pictures: they were lost, or recordings were put together"
        why = self._ended or self._unfinished()
        if why:
            yield f"is unfinished: {why}"

    def _unfinished(self) -> str:
        # The reason why the played part is not the whole film; empty if nothing shows one.
        container, stream = self._container, self._stream
        if (size := _size_of(container)) != self._size:
            return f"it has grown by {(size or 0) - (self._size or 0)} bytes since: --follow waits for more"
        count, said = self._frames_there(), stream.frames
        if (
            "mp4" in container.format.name and not said and self._lacks_bytes()
        ):  # in fragments it counts no frames
            return "its last fragment is cut"
        if said and "mp4" in container.format.name:  # without frames hidden by an edit list
            said = len(stream.index_entries)
        if count < said and (self._lacks_bytes() or count < 0.98 * said - 2):
            return f"{count} of its {said} frames are there"
        if (why := self._lacks_pictures()) or container.format.name == "mpegts":
            return why
        # The container's duration may be that of the sound.
        whole = stream.duration or len(container.streams) == 1 or container.format.name == _IN_SEGMENTS
        said_s = duration_s(stream) if whole else None
        if said_s is not None and self.end_s is not None:
            said_s -= self.ahead_s  # a header counts them
            missing_s = said_s - (self.end_s - self._begin_s)
            if missing_s > max(Fraction(1), said_s / 50) and not self._is_rounded():
                return f"it is {float(missing_s):.1f} s shorter than its header says"
        return ""

    def _is_rounded(self) -> bool:
        # Whether it is an HLS playlist of the first versions, in which segments last whole seconds.
        name = Path(self._container.name.removeprefix("file:"))
        text = name.read_text(errors="replace") if name.suffix.lower() == _PLAYLIST and name.is_file() else ""
        return bool(re.search(r"^#EXTINF:\d+,", text, re.MULTILINE))

    def _frames_there(self) -> int:
        if self._container.format.name != "avi":
            return self._count
        # With the frames that its recorder dropped, by the places of the others.
        return max(self._count, math.ceil((self.end_s or 0) * (self._stream.average_rate or 0)))

    def _lacks_pictures(self) -> str:
        # The same for formats without an index, and for two joined MP4 files, by their bytes.
        name, size = self._container.format.name, self._size or 0
        boxes = _boxes_of(Path(self._container.name.removeprefix("file:"))) if "mp4" in name else []
        joined = sum(kind == b"moov" for kind, _ in boxes) > 1
        if joined and not self._stream.frames:
            return "another recording is behind it, in fragments that FFmpeg takes for those of the first"
        numbers = [number for kind, number in boxes if kind == b"moof"]
        for before, later in pairwise(numbers):
            if later > before + 1 and not joined:
                return f"its fragments are not in a row: number {later} follows {before}"
        if numbers and numbers[0] > 2 and not joined:
            return f"its first fragment is number {numbers[0]}: is its beginning missing?"
        if numbers and not all(re.fullmatch(rb"[ -~]{4}", kind) for kind, _ in boxes):
            return f"its last {size - self._end_byte} bytes hold no fragment that can be read"
        ends = name in _WITHOUT_INDEX or joined
        behind = 1 - self._end_byte / size if size and ends else 0
        if behind > _MOST_BEHIND:
            return f"its last {behind:.0%} hold nothing of this film, but perhaps another recording"
        broken = name == "mpegts" and all(size % one for one in _TS_BYTES)
        return "its last packet is cut" if broken else ""

    def _lacks_bytes(self) -> bool:
        # Whether its index names places beyond its end.
        return bool(self._size) and any(
            one.pos + one.size > (self._size or 0) for one in self._stream.index_entries
        )


def packets_of(container: Any, stream: Any) -> Iterator[Any]:
    """All packets of a stream; where it breaks off, the error comes last."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except (StopIteration, IndexError):
            return  # the second where another stream began: PyAV has no stream of its number
        except av.error.FFmpegError as error:
            yield error
            return
        yield packet


def is_picture_each(stream: Any) -> bool:
    """Whether each packet is a picture: one of H.264 or HEVC may hold none, which FFmpeg calls damaged."""
    return str(stream.codec_context.name) == "mjpeg"


class Decoder:
    """Decodes the packets of one stream; ``patched`` counts the damaged pictures that it gave out.

    A JPEG whose damage the decoder notices is none of these while others are whole: each is a picture of its own, and
    the one before is seen instead. Where none is whole, as of a camera that breaks the standard in each, they are
    shown: ``whole`` says that the first ones are not known to be such.
    """

    def __init__(self, stream: Any, *, whole: bool = True) -> None:
        self._stream = stream
        self._damaged_in_a_row = 0 if whole else _MOST_DAMAGED
        self._damaged_at_s = 0.0
        self.patched = 0

    def decode(self, packet: Any, *, now_s: float = 0.0) -> list[av.VideoFrame]:
        """The pictures of a packet, of the stream's own codec; after an error those that were held back.

        ``now_s`` is the time at which a live one came, in seconds. Raises `FFmpegError` for a damaged packet.
        """
        if isinstance(packet, Exception):
            return list(self._stream.codec_context.decode(None))
        try:
            frames: list[av.VideoFrame] = list(packet.decode())
        except av.error.FFmpegError:
            if not self._damaged_in_a_row:
                self._damaged_at_s = now_s
            self._damaged_in_a_row += 1
            few = self._damaged_in_a_row <= _MOST_DAMAGED and now_s - self._damaged_at_s <= _MOST_DAMAGED_S
            if few or not is_picture_each(self._stream):
                raise
            # One that has decoded no other: FFmpeg would go on with an older picture where this one is cut.
            frames = av.CodecContext.create("mjpeg", "r").decode(packet)
            self.patched += len(frames)
        else:
            self._damaged_in_a_row = 0
            self.patched += sum(frame.is_corrupt for frame in frames)
        return frames


def _lacks_index(path: Path) -> str:
    # The fault of an MP4 whose index is missing; empty for anything else.
    kinds = [kind for kind, _ in _boxes_of(path)]
    if kinds[:1] != [b"ftyp"] or b"moov" in kinds:
        return ""
    return (
        "unfinished: an MP4 has its index (moov) at its end, and this one has none, because it was cut or is still "
        "recorded; Matroska, MPEG-TS and fragmented MP4 can be read so far, and while they grow with --follow"
    )


def _boxes_of(path: Path) -> list[tuple[bytes, int]]:
    # The kinds of the first boxes of an MP4 (ISO/IEC 14496-12, 4.2), and of fragments their numbers (8.8.5).
    boxes: list[tuple[bytes, int]] = []
    with suppress(OSError), path.open("rb") as file:
        end = path.stat().st_size
        at = 0
        while at + 8 <= end and len(boxes) < _MOST_BOXES:
            file.seek(at)
            head = file.read(24)
            if not any(head) and not file.read(_MOST_ZEROS).strip(b"\0"):
                break  # space that a recorder reserved
            boxes.append((head[4:8], int.from_bytes(head[20:], "big")))
            size = int.from_bytes(head[:4], "big")
            size = int.from_bytes(head[8:16], "big") if size == 1 else size
            if size < 8:
                break
            at += size
    return boxes


def _seconds(stamp: int | None, base: Fraction | None) -> Fraction | None:
    return None if stamp is None or base is None else stamp * base


def _size_of(container: Any) -> int | None:
    name = str(container.name or "")
    with suppress(OSError, ValueError):
        return Path(name.removeprefix("file:")).stat().st_size if name.startswith("file:") else None
    return None


def cause_of(error: Exception) -> str:
    """The cause in FFmpeg's or the system's error, without the address that it may hold."""
    if isinstance(error, av.error.ExitError):
        return "no answer in time"
    return redacted(str(getattr(error, "strerror", None) or error))
