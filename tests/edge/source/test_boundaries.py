"""JPEGs over HTTP as cameras send them, with and without the boundaries that the standard wants."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import pytest

from hvt_common.errors import UserError
from hvt_edge.source.opening import open_source
from media.numbered import number_of, numbered


@pytest.fixture
def camera():
    """Serves `numbered` pictures; ``/cut`` without the first boundary, ``/jpg`` of that kind, ``/torn`` halves."""
    stop = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_words):
            """Say nothing."""

        def do_GET(self):
            """Send pictures."""
            self.send_response(200)
            kind = "text/html" if self.path == "/page" else "multipart/x-mixed-replace; boundary=frame"
            self.send_header("Content-Type", kind)
            self.end_headers()
            number = 0
            while not stop.wait(0.02):
                data = cv2.imencode(".jpg", numbered(number % 1000))[1].tobytes()
                data = data[: len(data) // 2] if self.path == "/torn" and number % 2 else data
                form = "jpg" if self.path == "/jpg" else "jpeg"
                head = f"Content-Type: image/{form}\r\nContent-Length: {len(data)}\r\n\r\n".encode()
                between = b"--frame\r\n" if number or self.path != "/cut" else b""
                try:
                    self.wfile.write(b"<html>" if self.path == "/page" else between + head + data + b"\r\n")
                except OSError:
                    return
                number += 1

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    stop.set()
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.mark.parametrize("path", ["whole", "cut", "jpg"])
def test_a_camera_plays_whatever_its_boundaries(camera, path):
    """A camera that every browser shows would be refused."""
    with open_source(f"{camera}/{path}", size=(320, 240), fps=25, max_frames=5) as source:
        assert source.live
        numbers = [number_of(frame.source_bgr) for frame in source.frames(start_ns=0)]
    assert len(numbers) == 5
    assert numbers == sorted(numbers)


def test_a_picture_that_is_cut_is_left_out_and_counted(camera):
    """In its place was half of an older one, and nobody knew how many came so."""
    with open_source(f"{camera}/torn", size=(320, 240), fps=25, max_frames=5) as source:
        numbers = [number_of(frame.source_bgr) for frame in source.frames(start_ns=0)]
        assert source.unreadable
    assert len(numbers) == 5
    assert not any(number % 2 for number in numbers)


def test_a_page_is_no_camera(camera):
    """What is no picture would be searched for pictures for ever."""
    with pytest.raises(UserError, match=r"cannot be opened|holds no video"):
        open_source(f"{camera}/page", size=(320, 240), fps=25)
