"""Decoded frames as a player shows them: deinterlaced, of square pixels, upright, in their colours, heat as grey."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import av
import av.error
import cv2
import numpy as np
import numpy.typing as npt
from av.filter import Graph
from av.sidedata.sidedata import SideDataContainer, Type
from av.video.reformatter import ColorPrimaries, Colorspace, ColorTrc, Interpolation, VideoReformatter

from hvt_common.values import Image
from hvt_edge.source.contract import Notes

# PyAV refuses all side data of a frame where FFmpeg has added a kind that PyAV has no name for, such as the EXIF
# data of a JPEG. Such a kind gets the name of one that is not read here.
Type._missing_ = classmethod(lambda cls, value: cls.VIDEO_HINT)  # type: ignore[assignment] # noqa: ARG005

_UNTAGGED_SD_PX = 576
"""A picture without a colour matrix is BT.601 up to this number of lines, else BT.709, as in players."""
_DEEP_BITS = 10
"""Grey of more bits is a sensor's levels, not brightness."""
_MOST_BITS, _DARK = 16, 1 << 14
"""Cameras of 14 bits and fewer leave the upper ones of sixteen empty. No header says so: it may as well be night."""
_COLOURS = 3
"""Components of a pixel in colour: a palette has one, grey with transparency two."""
_HDR = {16: "PQ", 18: "HLG"}
"""Transfers of ITU-T H.273, table 3."""
_BT709, _BT601 = 1, 6
_UNSAID = (0, 2, 3)
"""Matrices of H.273, table 4, that give none: 0 is RGB, which no YUV is, 2 is unspecified, 3 is reserved."""
_CONVERTED = (1, 4, 5, 6, 7, 9)
"""Matrices that swscale converts: not YCgCo, ICtCp and inventions of broken encoders."""
_MOST_ASPECT = 8
_Turn = tuple[bool, bool, bool]
"""Whether rows become columns, and whether it is then mirrored left to right, and upside down."""
_UPRIGHT = (False, False, False)
_WITH_SEI = frozenset({"h264", "hevc"})
"""Codecs that signal a turn by a message at a keyframe, which holds for the following pictures (H.274, 8.9)."""
_TURNS = {
    _UPRIGHT: "",
    (False, True, False): "mirrored left to right",
    (False, False, True): "mirrored upside down",
    (False, True, True): "turned by 180 degrees",
    (True, False, False): "mirrored and turned by 90 degrees",
    (True, True, False): "turned by 90 degrees clockwise",
    (True, False, True): "turned by 90 degrees anticlockwise",
    (True, True, True): "mirrored and turned by 270 degrees",
}


class Pictures:
    """The pictures of one stream, for as long as it is read; ``notes`` has the decisions and their reasons."""

    def __init__(self, notes: Notes) -> None:
        self.say = notes
        self._reformatter = VideoReformatter()
        """Reused: the table of an HDR picture takes seconds to make."""
        self._stretch = Stretch(notes)
        self._aspect = Fraction(1)
        """Width of a pixel over its height, by the container, or by the film at its beginning."""
        self._aspects: dict[tuple[int, int], Fraction] = {}
        """The newest aspect of pictures by (width, height)."""
        self._coded_aspect: Fraction | None = None
        self._held_turn: _Turn | None = None
        """The newest turn signalled by the film itself."""
        self._graph: Graph | None = None
        self._shape: tuple[int, int, str] | None = None
        """(width, height, format) for which the graph was made."""
        self._stream: Any = None

    def begin(self, stream: Any) -> None:
        """Read ``stream`` from here on; the container's pixel aspect goes before the codec's."""
        self._stream, self._graph, self._held_turn = stream, None, None
        self._aspects, self._coded_aspect = {}, None
        self._aspect = self._checked_aspect(stream.sample_aspect_ratio)

    def _checked_aspect(self, said: Fraction | None) -> Fraction:
        aspect = Fraction(said or 1)
        if not Fraction(1, _MOST_ASPECT) <= aspect <= _MOST_ASPECT:
            self.say(f"pixels {float(aspect):g} times as wide as high are taken for a fault: they are square")
            return Fraction(1)
        if aspect != 1:
            self.say(f"its pixels are {float(aspect):.3g} times as wide as high: made square")
        return aspect

    def _note(self, frame: av.VideoFrame) -> None:
        # A film may change in its midst how it is to be shown, and the change holds for the following frames.
        codec = self._stream.codec_context
        coded = codec.sample_aspect_ratio or Fraction(1)
        self._coded_aspect = self._coded_aspect or coded
        changed = coded != self._coded_aspect
        self._aspects[frame.width, frame.height] = self._checked_aspect(coded) if changed else self._aspect
        if codec.name in _WITH_SEI:
            self._held_turn = _turn_of(frame) or self._held_turn

    def frames(self, frame: av.VideoFrame | None) -> Iterator[av.VideoFrame]:
        """The picture of a decoded frame: deinterlaced, and then one frame later; None at the end.

        Frames of interlaced film are interpolated in time (bwdif); others pass as they are.
        """
        if frame is not None:
            self._note(frame)
        if frame is not None and not frame.interlaced_frame and self._graph is None:
            yield frame
            return
        if frame is not None and self._shape_of(frame) != (self._shape if self._graph else None):
            yield from self._drained()
            self.say("its film is interlaced: bwdif makes whole pictures of it")
            self._make_graph(frame)
        if frame is None:
            yield from self._drained()
        elif self._graph is not None:
            self._graph.vpush(frame)
            yield from self._pulled()

    def bgr(self, frame: av.VideoFrame) -> Image:
        """(height, width, 3) uint8, with square pixels, turned and mirrored by the display matrix."""
        picture = self._upright_colours(frame)
        turn = _turn_of(frame) or self._held_turn or _UPRIGHT
        if said := _TURNS[turn]:
            self.say(f"it is to be shown {said}, and is")
            swap, mirror, flip = turn
            picture = np.swapaxes(picture, 0, 1) if swap else picture
            picture = picture[:: -1 if flip else 1, :: -1 if mirror else 1]
        return np.ascontiguousarray(picture)

    def _upright_colours(self, frame: av.VideoFrame) -> Image:
        wide, high = self._square(frame)
        name, components = frame.format.name, frame.format.components
        if (
            name.startswith(("gray", "ya16"))
            and not name.startswith("grayf")
            and components[0].bits > _DEEP_BITS
        ):
            levels = self._reformatter.reformat(
                frame, width=wide, height=high, format="gray16le", threads=1
            ).to_ndarray()
            bits = components[0].bits
            own = np.asarray(levels, np.uint16) >> (16 - bits)
            return self._stretch.bgr(own, at_s=frame.time or 0.0, bits=bits)
        deep_bayer = frame.format.is_bayer and frame.format.bits_per_pixel == _MOST_BITS
        is_deep = deep_bayer or components[0].bits == _MOST_BITS
        if frame.format.is_rgb and is_deep and frame.color_trc not in _HDR:
            deep = self._reformatter.reformat(frame, width=wide, height=high, format="bgr48le", threads=1)
            return self._stretch.colours(np.asarray(deep.to_ndarray(), np.uint16))
        more: dict[str, Any] = {}
        if len(components) >= _COLOURS:
            if not frame.format.is_rgb and frame.colorspace not in _CONVERTED:
                matrix = matrix_of(frame)
                standard = "BT.709" if matrix == _BT709 else "BT.601"
                said = int(frame.colorspace)
                which = "no colour matrix" if said in _UNSAID else f"colour matrix {said}, which FFmpeg lacks"
                self.say(f"it says {which}: {standard}, because it has {frame.height} lines")
                more["src_colorspace"] = Colorspace.ITU709 if matrix == _BT709 else Colorspace.ITU601
            if frame.color_trc in _HDR:
                self.say(f"it is HDR ({_HDR[frame.color_trc]}): tone-mapped to BT.709")
                more |= {"dst_color_trc": ColorTrc.BT709, "dst_color_primaries": ColorPrimaries.BT709}
        how = Interpolation.BICUBIC if (wide, high) != (frame.width, frame.height) else Interpolation.BILINEAR
        converted = self._reformatter.reformat(
            frame, width=wide, height=high, format="bgr24", interpolation=how, threads=1, **more
        )
        return np.asarray(converted.to_ndarray(), np.uint8)

    def _square(self, frame: av.VideoFrame) -> tuple[int, int]:
        # (width, height) with square pixels: one side grows, so that no detail is lost.
        aspect = self._aspects.get((frame.width, frame.height), self._aspect)
        if aspect >= 1:
            return max(2, round(frame.width * aspect)), frame.height
        return frame.width, max(2, round(frame.height / aspect))

    @staticmethod
    def _shape_of(frame: av.VideoFrame) -> tuple[int, int, str]:
        return frame.width, frame.height, frame.format.name

    def _make_graph(self, frame: av.VideoFrame) -> None:
        graph = Graph()
        graph.threads = 1
        source = graph.add_buffer(
            width=frame.width, height=frame.height, format=frame.format, time_base=self._stream.time_base
        )
        deinterlace = graph.add("bwdif", "mode=send_frame:parity=auto:deint=interlaced")
        graph.link_nodes(source, deinterlace, graph.add("buffersink")).configure()
        self._graph, self._shape = graph, self._shape_of(frame)

    def _drained(self) -> Iterator[av.VideoFrame]:
        if self._graph is not None:
            self._graph.vpush(None)
            yield from self._pulled()
            self._graph = None

    def _pulled(self) -> Iterator[av.VideoFrame]:
        while self._graph is not None:
            try:
                frame = self._graph.vpull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return
            yield frame


def matrix_of(frame: av.VideoFrame) -> int:
    """The colour matrix of a YUV frame (H.273, table 4): its tag, else by its height."""
    if frame.colorspace in _CONVERTED:
        return int(frame.colorspace)
    return _BT709 if frame.height > _UNTAGGED_SD_PX else _BT601


def turn_of(frame: av.VideoFrame) -> str:
    """The turn of a frame by its display matrix, to the nearest right angle, in words; empty for none."""
    return _TURNS[_turn_of(frame) or _UPRIGHT]


def _turn_of(frame: av.VideoFrame) -> _Turn | None:
    # The turn by the display matrix (ISO/IEC 14496-12, 8.3.2); None without one.
    # Not `frame.side_data`: its object and the frame refer to each other, and each picture would stay until Python's
    # cycle collector runs, a hundred megabytes later.
    container: Any = SideDataContainer
    said = container(frame).get("DISPLAYMATRIX")
    if said is None:
        return None
    matrix = np.frombuffer(bytes(said), np.int32)
    a, b, c, d = (int(matrix[place]) for place in (0, 1, 3, 4))
    if abs(b) + abs(c) > abs(a) + abs(d):
        return True, c < 0, b < 0
    return False, a < 0, d < 0


_LOW_PCT, _HIGH_PCT = 0.5, 99.5
_LEAST_SPAN = 64
"""Sensor levels: a wall of one temperature must not become noise from black to white."""
_LEAST_DEGREES = 1.0
"""The same for floating-point pictures, which are in degrees, or from 0 to 1."""
_SETTLING_S = 3.0
"""A warm body that comes in must not darken the rest of the picture at once."""
_LONGEST_S = 1.0
_EACH = 4
"""Each fourth pixel of each fourth row is sample enough."""


class Stretch:
    """A sensor's levels as eight bits: those of grey between their percentiles 0.5 and 99.5.

    These follow the scene with a time constant of three seconds.

    ``note`` receives the first levels.
    """

    def __init__(self, note: Callable[[str], None]) -> None:
        self._note = note
        self._range: tuple[float, float] | None = None
        self._at_s = 0.0
        self._coloured = False

    def colours(self, levels: npt.NDArray[np.uint16]) -> Image:
        """(height, width, 3) BGR of sixteen bits as uint8; that the first picture is dark is noted."""
        if not self._coloured and 0 < levels.max() < _DARK:
            self._note(
                f"its 16-bit colours go up to {levels.max()} of 65535 in the first picture, which is dark: if its "
                "camera has 10, 12 or 14 bits, multiply the values by 64, 16 or 4 first"
            )
        self._coloured = True
        return np.asarray(cv2.convertScaleAbs(levels, alpha=1 / 257), np.uint8)

    def bgr(self, levels: npt.NDArray[Any], *, at_s: float, bits: int = 0) -> Image:
        """(height, width) numbers as (height, width, 3) uint8; ``at_s`` is the picture's time in seconds.

        Values that are not finite, where a sensor saw nothing, become black. ``bits`` is the source's depth, where
        the array has more.
        """
        first, bits = self._range is None, bits or 8 * levels.itemsize
        least: float = _LEAST_SPAN
        if np.issubdtype(levels.dtype, np.floating):
            seen = np.isfinite(levels)
            levels = np.where(seen, levels, levels[seen].min() if seen.any() else 0)
            least = _LEAST_DEGREES
        low, high = self._settle(np.percentile(levels[::_EACH, ::_EACH], (_LOW_PCT, _HIGH_PCT)), at_s)
        missing = max(0.0, least - (high - low)) / 2
        low, high = low - missing, high + missing
        if first:
            self._note(
                f"its {bits}-bit grey is a sensor's: levels {low:.5g} to {high:.5g} are stretched to black and "
                f"white, the percentiles {_LOW_PCT} and {_HIGH_PCT}, which follow the scene slowly"
            )
        scaled = (levels.astype(np.float32) - np.float32(low)) * np.float32(255 / (high - low))
        return np.repeat(np.clip(np.rint(scaled), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)

    def _settle(self, found: npt.NDArray[np.float64], at_s: float) -> tuple[float, float]:
        passed_s = min(_LONGEST_S, max(0.0, at_s - self._at_s))
        self._at_s = at_s
        if self._range is None:
            self._range = float(found[0]), float(found[1])
        share = 1 - math.exp(-passed_s / _SETTLING_S)
        low, high = (old + share * (float(new) - old) for old, new in zip(self._range, found, strict=True))
        self._range = low, high
        return low, high
