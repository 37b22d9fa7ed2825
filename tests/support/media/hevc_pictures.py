"""HEVC pictures of any announced size, written by hand (ITU-T H.265, clause 7.3): what no encoder would make."""

from hvt_common.protocol.messages.bits import BitWriter, escaped

_CHROMA_QP_OFFSET = 2

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
    writer.se(_CHROMA_QP_OFFSET).se(_CHROMA_QP_OFFSET).u(_PICTURE_END, 8)
    return writer.u(0, 2).ue(0).u(0, 2).ended()  # no lists, merge level, no extension
