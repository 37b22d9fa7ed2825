"""A camera that speaks RTSP (RFC 2326) over TCP, with RTCP sender reports; it can go away and come back."""

import contextlib
import socket
import struct
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from hvt_common.video.hevc import PARAMETER_SETS, nal_kind, nal_units

SIZE = (320, 240)
_FPS = 25
_NTP_EPOCH_S = 2_208_988_800
_SSRC, _JPEG, _CLOCK_HZ = 0x48565431, 26, 90_000
_HEVC = 96
_SDP = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nt=0 0\r\nm=video 0 RTP/AVP {kind}\r\n{more}a=control:track\r\n"


class RtspCamera:
    """Serves one viewer at a time; ``clock_ns`` is the camera's own, ``delay_s`` how late its frames are sent.

    A picture is a motion JPEG (RFC 2435) of one grey level, in one packet. With ``units``, HEVC access units (RFC
    7798), those are sent over and over, and their parameter sets in the stream's description alone.
    """

    def __init__(
        self,
        port: int,
        *,
        clock_ns: Callable[[], int] = time.time_ns,
        delay_s: float = 0.0,
        units: Sequence[bytes] = (),
    ) -> None:
        self._pictures = [
            [one for one in nal_units(unit) if nal_kind(one) not in PARAMETER_SETS] for unit in units
        ]
        sets = {nal_kind(one): one for one in nal_units(units[0])} if units else {}
        names = {32: "vps", 33: "sps", 34: "pps"}
        sprop = ";".join(f"sprop-{names[kind]}={b64encode(sets[kind]).decode()}" for kind in names if sets)
        more = f"a=rtpmap:{_HEVC} H265/{_CLOCK_HZ}\r\na=fmtp:{_HEVC} {sprop}\r\n" if units else ""
        self._sdp = _SDP.format(kind=_HEVC if units else _JPEG, more=more)
        self.url = f"rtsp://127.0.0.1:{port}/camera"
        self._clock_ns = clock_ns
        self._delay_s = delay_s
        self._stop = threading.Event()
        self._server = socket.create_server(("127.0.0.1", port), reuse_port=True)
        self._server.settimeout(0.1)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hang up and stop listening, as when the power fails."""
        self._stop.set()
        self._thread.join(60)
        self._server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(OSError):
                viewer, _ = self._server.accept()
                with viewer:
                    viewer.settimeout(0.1)
                    self._talk(viewer)

    def _talk(self, viewer: socket.socket) -> None:
        pending = b""
        while not self._stop.is_set():
            with contextlib.suppress(TimeoutError):
                received = viewer.recv(4096)
                if not received:
                    return
                pending += received
            while b"\r\n\r\n" in pending:
                request, pending = pending.split(b"\r\n\r\n", 1)
                lines = request.decode().split("\r\n")
                method, number = lines[0].split()[0], next(one for one in lines if one.startswith("CSeq"))
                more, body = "", ""
                if method == "DESCRIBE":
                    body = self._sdp
                    more = f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
                elif method == "SETUP":
                    more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n"
                elif method == "OPTIONS":
                    more = "Public: DESCRIBE, SETUP, PLAY\r\n"
                viewer.sendall(f"RTSP/1.0 200 OK\r\n{number}\r\n{more}\r\n{body}".encode())
                if method == "PLAY":
                    self._play(viewer)
                    return

    def _play(self, viewer: socket.socket) -> None:
        began_ns, sent, packets = self._clock_ns(), 0, 0
        while not self._stop.wait(1 / _FPS):
            taken_ns = self._clock_ns()
            stamp = round((taken_ns - began_ns) * _CLOCK_HZ / 1e9) & 0xFFFFFFFF
            time.sleep(self._delay_s)
            if sent % _FPS == 0:
                viewer.sendall(_interleaved(1, _sender_report(taken_ns, stamp, sent)))
            for kind, payload in self._payloads(sent):
                header = struct.pack(">BBHII", 0x80, kind, packets & 0xFFFF, stamp, _SSRC)
                viewer.sendall(_interleaved(0, header + payload))
                packets += 1
            sent += 1

    def _payloads(self, number: int) -> list[tuple[int, bytes]]:
        """(payload type, payload) of each packet of a picture; the last has the marker bit."""
        if not self._pictures:
            return [(0x80 | _JPEG, _picture(number))]
        nals = self._pictures[number % len(self._pictures)]
        return [(_HEVC | 0x80 * (nal is nals[-1]), nal) for nal in nals]


def _interleaved(channel: int, packet: bytes) -> bytes:
    """RFC 2326, section 10.12."""
    return b"$" + struct.pack(">BH", channel, len(packet)) + packet


def _sender_report(at_ns: int, stamp: int, sent: int) -> bytes:
    """RFC 3550, section 6.4.1."""
    seconds, rest_ns = divmod(at_ns, 1_000_000_000)
    ntp = ((seconds + _NTP_EPOCH_S) << 32) | (rest_ns << 32) // 1_000_000_000
    return struct.pack(">BBHIQIII", 0x80, 200, 6, _SSRC, ntp, stamp, sent, sent * 100)


def _picture(number: int) -> bytes:
    """A grey JPEG as RFC 2435 has it: main header, quantisation tables, scan."""
    grey = np.full((SIZE[1], SIZE[0], 3), 40 + number % 20 * 8, np.uint8)
    jpeg = cv2.imencode(".jpg", grey)[1].tobytes()
    tables = b"".join(part[3:67] for part in jpeg.split(b"\xff\xdb")[1:3])
    scan_at = jpeg.index(b"\xff\xda")
    scan = jpeg[scan_at + 2 + int.from_bytes(jpeg[scan_at + 2 : scan_at + 4], "big") : -2]
    main = struct.pack(">BBHBBBB", 0, 0, 0, 1, 255, SIZE[0] // 8, SIZE[1] // 8)
    return main + struct.pack(">BBH", 0, 0, 128) + tables + scan
