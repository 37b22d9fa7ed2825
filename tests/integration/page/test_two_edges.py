"""Two edges on one page in a real browser: nothing of one is ever shown as the other's."""

import itertools
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from hvt_ground.events import Notice, VideoSample
from hvt_web.server import WebPage
from media.moving_square import FPS, SIZE, moving_square
from programs.processes import eventually, free_ports
from rigs.messages import INFO

pytestmark = [pytest.mark.nightly, pytest.mark.integration]

_SHOWN = """() => {
  const video = document.getElementById("video");
  const image = document.getElementById("still-picture");
  const drawn = (!video.hidden && video.readyState > 1) || (!image.hidden && image.naturalWidth > 0);
  return { drawn, name: document.getElementById("name").textContent };
}"""


@pytest.fixture
def address() -> Iterator[str]:
    """A page with an edge that flies, and one of which no picture comes any more."""
    (port,) = free_ports(1)
    units = list(moving_square("libx265", 60))
    ended = threading.Event()
    with WebPage(f"127.0.0.1:{port}", clock=time.time_ns) as page:

        def fly(edge: str, number: int, *, stops: bool) -> None:
            sizes: Any = {"base_size": SIZE, "source_size": SIZE, "fps": FPS, "pace": "realtime"}
            sink = page.feed(replace(INFO, edge=edge, session_id=number, **sizes))()
            for index, (data, keyframe) in enumerate(itertools.cycle(units)):
                if ended.wait(1 / FPS):
                    return
                if not stops:
                    sink.log(VideoSample(index, time.time_ns(), data, keyframe))

        flights = (("flies", 1, False), ("silent", 2, True))
        threads = [
            threading.Thread(target=fly, args=(edge, number), kwargs={"stops": stops})
            for edge, number, stops in flights
        ]
        for one in threads:
            one.start()
        yield f"http://127.0.0.1:{port}/"
        ended.set()
        for one in threads:
            one.join()


@pytest.mark.parametrize("rung", ["h264", "jpeg"])
def test_no_pixel_of_one_edge_stands_under_the_name_of_another(browser, address, rung):
    """An operator would take the first edge's street for the second one's, in colour."""
    page = browser.new_page()
    page.goto(f"{address}#edge=flies&rung={rung}")
    eventually(lambda: page.evaluate(_SHOWN)["drawn"], what="the first edge's picture")
    page.locator('.edge[data-edge="silent"]').click()
    for _ in range(10):
        assert page.evaluate(_SHOWN) == {"drawn": False, "name": "silent"}
        time.sleep(0.1)
    assert page.inner_text("#objects-title") == "Tracks: not known yet"
    page.locator('.edge[data-edge="flies"]').click()
    eventually(lambda: page.evaluate(_SHOWN)["drawn"], what="the first edge's picture again")
    page.close()


def test_an_edge_that_starts_again_bears_no_word_of_the_flight_before(browser):
    """``this session has ended`` stood beside the green light of one that flies."""
    (port,) = free_ports(1)
    with WebPage(f"127.0.0.1:{port}", clock=time.time_ns) as ground:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}/")
        ground.feed(INFO)().log(Notice(0, 0, "info", "the flight has ended"))
        page.locator(".last", has_text="the flight has ended").wait_for()
        page.keyboard.press("k")
        page.locator("#settings-text", has_text="the link is not open yet").wait_for(state="attached")
        ground.feed(replace(INFO, session_id=INFO.session_id + 1))()
        for where in (".last", "#settings-text"):
            eventually(lambda where=where: not page.text_content(where), what=f"no word in {where}")
        page.close()
