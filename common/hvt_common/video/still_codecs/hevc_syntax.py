"""The HEVC headers around one intra slice (ITU-T H.265, clause 7.3), so that they need not cross the link.

As in `h264_syntax`: the edge cuts x265's headers off and checks that they mean what is written here, and the ground
writes these. Blocks of 32 down to 8, no sample-adaptive offset (on a crop its choice costs more bits than it saves),
sign data hiding, colour 2 QP steps coarser.
"""

from __future__ import annotations

from hvt_common.video.still_codecs.bits import BitReader, BitWriter, escaped, nal_units, unescaped

__all__ = ["CHROMA_QP_OFFSET", "cabac_data", "coded_picture"]

CHROMA_QP_OFFSET = 2

_START = b"\x00\x00\x00\x01"
_IDR, _VPS, _SPS, _PPS = 20, 32, 33, 34
_I = 2
_MAIN, _LEVEL_6_2 = 1, 186
_INITIAL_QP = 26

# What the slice data hangs on. Sequence: 4:2:0; 8 bits; blocks of 8 to 32 and transforms of 4 to 32, not split
# further by themselves; no scaling lists, asymmetric blocks, sample-adaptive offset, verbatim blocks or smoothing.
_SAMPLES = (1,)
_DEPTHS = (0, 0)
_BLOCKS = (0, 2, 0, 3, 0, 0)
_SEQUENCE_TOOLS = (0, 0, 0, 0)
# Picture: whole slices; sign hiding; QP 26; then neither constrained prediction, transform skip nor QP changes.
_PICTURE_START = (0, 0, 0b0000010)
_PICTURE_TOOLS = 0b000
_PICTURE_END = 0b00000010
"""No chroma offsets in slices, no weights, no lossless blocks, no tiles, no wavefronts; filter across slices; no
control of deblocking."""


def coded_picture(cabac: bytes, *, size: tuple[int, int], qp: int) -> bytes:
    """Annex B: parameter sets and an IDR picture of ``size`` (whole blocks of 8) around its CABAC data."""
    header = BitWriter().u(0b10, 2).ue(0, _I).se(qp - _INITIAL_QP).u(1, 1).ended()
    return (
        _unit(_VPS, _video())
        + _unit(_SPS, _sequence(size))
        + _unit(_PPS, _picture())
        + _unit(_IDR, header + cabac)
    )


def cabac_data(stream: bytes, *, size: tuple[int, int], qp: int) -> bytes:
    """The CABAC data of the one picture in ``stream``, x265's Annex B with its parameter sets.

    A build of x265 that means something else than `coded_picture` raises RuntimeError.
    """
    units = {unit[0] >> 1 & 63: unescaped(unit[2:]) for unit in nal_units(stream)}
    _check_sequence(BitReader(units[_SPS]), size)
    _check_picture(BitReader(units[_PPS]))
    body = units[_IDR]
    reader = BitReader(body[:16])
    found = [reader.u(2), *reader.ues(2), _INITIAL_QP + reader.se(), reader.u(1), reader.u(1)]
    if found != [0b10, 0, _I, qp, 1, 1]:
        raise RuntimeError(f"x265 wrote a slice header of {found}")
    return body[reader.next_byte() :]


def _unit(kind: int, body: bytes) -> bytes:
    return _START + bytes([kind << 1, 1]) + escaped(body)


def _profile(writer: BitWriter) -> BitWriter:
    writer.u(_MAIN, 8).u(0x60000000, 32).u(0b1001, 4).u(0, 44)
    return writer.u(_LEVEL_6_2, 8)


def _video() -> bytes:
    writer = BitWriter().u(0, 4).u(0b11, 2).u(0, 6).u(0, 3).u(1, 1).u(0xFFFF, 16)
    return _profile(writer).u(1, 1).ue(0, 0, 0).u(0, 6).ue(0).u(0, 2).ended()


def _sequence(size: tuple[int, int]) -> bytes:
    writer = _profile(BitWriter().u(0, 4).u(0, 3).u(1, 1))
    writer.ue(0, *_SAMPLES, *size).u(0, 1).ue(*_DEPTHS, 0).u(1, 1).ue(0, 0, 0).ue(*_BLOCKS)
    for tool in _SEQUENCE_TOOLS:
        writer.u(tool, 1)
    # No reference pictures of any kind, no smoothing, no VUI, no extension.
    return writer.ue(0).u(0, 2).u(0, 1).u(0, 2).ended()


def _picture() -> bytes:
    writer = BitWriter().ue(*_PICTURE_START[:2]).u(_PICTURE_START[2], 7).ue(0, 0).se(0).u(_PICTURE_TOOLS, 3)
    writer.se(CHROMA_QP_OFFSET).se(CHROMA_QP_OFFSET).u(_PICTURE_END, 8)
    return writer.u(0, 2).ue(0).u(0, 2).ended()  # no lists, merge level, no extension


def _check_sequence(reader: BitReader, size: tuple[int, int]) -> None:
    reader.u(8 + 96)  # identity and profile
    found = [*reader.ues(4), reader.u(1), *reader.ues(2)]
    reader.ue()  # bits of the picture order count: an IDR has none
    for _ in range(1 if reader.u(1) else 0):
        reader.ues(3)  # sizes of buffers
    found += [*reader.ues(6), *(reader.u(1) for _ in range(4)), *reader.ues(1)]
    reader.u(2)  # long-term references and motion prediction: not in an intra picture
    found.append(reader.u(1))
    if found != [0, *_SAMPLES, *size, 0, *_DEPTHS, *_BLOCKS, *_SEQUENCE_TOOLS, 0, 0]:
        raise RuntimeError(f"x265 wrote a sequence parameter set of {found}")


def _check_picture(reader: BitReader) -> None:
    found = [*reader.ues(2), reader.u(7)]
    reader.ues(2)  # references
    found += [reader.se(), reader.u(3), reader.se(), reader.se(), reader.u(8)]
    wanted = [*_PICTURE_START, 0, _PICTURE_TOOLS, CHROMA_QP_OFFSET, CHROMA_QP_OFFSET, _PICTURE_END]
    if found != wanted:
        raise RuntimeError(f"x265 wrote a picture parameter set of {found}")
