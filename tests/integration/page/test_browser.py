"""The page in a real browser, on a real flight: what an operator sees and can do."""

import re
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from programs.processes import PATIENT_S, Link, Running, eventually, free_ports

pytestmark = pytest.mark.integration

_PIXELS = """() => {
  const video = document.getElementById("video");
  const canvas = document.createElement("canvas");
  canvas.width = 64; canvas.height = 36;
  const context = canvas.getContext("2d");
  context.drawImage(video, 0, 0, 64, 36);
  return Array.from(context.getImageData(0, 0, 64, 36).data).join();
}"""
_OUTLINE = """() => ["img", "rect"].map(
  (one) => document.querySelector(`#stills ${one}`).getBoundingClientRect().toJSON())"""


@dataclass
class Flight:
    """An edge that flies, and the page that shows it."""

    address: str
    edge: Running
    browser: Any

    def page(self, fragment: str = "", **more) -> Any:
        page = self.browser.new_context(**more).new_page()
        page.set_default_timeout(1000 * PATIENT_S)
        page.goto(f"{self.address}#{fragment}")
        return page


@pytest.fixture(scope="module")
def flight(browser: Any, long_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flight]:
    folder = tmp_path_factory.mktemp("page")
    port = free_ports(1)[0]
    with Link(folder, name="page") as link:
        ground = link.ground(
            *("--record", "flight.rrd", "--detector", "motion", "--classifier", "none"),
            *("--web", f"127.0.0.1:{port}"),
        )
        ground.until(f"watch at http://127.0.0.1:{port}/")
        edge = link.edge(
            *("--source", str(long_scene), "--source-fps", "10", "--fps", "10", "--size", "640x360"),
            *("--preset", "ultrafast", "--budget", "500kbps", "--video-share", "0.6", "--edge-id", "uav-1"),
            *("--method", "M5", "--detector", "motion", "--cooldown", "0s"),
        )
        yield Flight(f"http://127.0.0.1:{port}/", edge, browser)
        assert ground.alive
        assert "Traceback" not in ground.said


@pytest.fixture
def page(flight: Flight) -> Iterator[Any]:
    page = flight.page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    logged = lambda said: said.type == "error" and errors.append(f"{said.text} {said.location}")  # noqa: E731
    page.on("console", logged)
    yield page
    # A still's picture may be gone before a slow browser asks for it.
    assert [error for error in errors if not ("404" in error and "/stills/" in error)] == []
    page.context.close()


def frame(page: Any) -> int:
    """The frame that the browser shows; -1 before the first."""
    return int(page.locator("#age").get_attribute("data-frame") or -1)


def shows(page: Any, *, after: int = -1) -> int:
    eventually(lambda: frame(page) > after, what="a picture is shown")
    return frame(page)


def test_the_picture_moves_and_falls_no_further_behind(page):
    """An operator would watch a picture that stands still, or one of long ago."""
    shows(page)
    seen: set[str] = set()

    def moved() -> bool:
        seen.add(page.evaluate(_PIXELS))
        return len(seen) > 20

    eventually(moved, what="other pixels")
    assert "H.264" in page.inner_text("#rung") or "HEVC" in page.inner_text("#rung")
    eventually(lambda: int(page.locator("#age").get_attribute("data-ms")) < 3000, what="it is of now")


@pytest.mark.nightly
def test_boxes_are_drawn_on_the_frame_that_is_shown(page):
    """Boxes would run before or behind what they are about."""
    shows(page)
    drawn = """() => {
      const canvas = document.getElementById("boxes");
      return canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.some((value) => value);
    }"""
    eventually(lambda: page.evaluate(drawn), what="a box is drawn")
    page.locator("#objects-title").click()
    eventually(lambda: page.locator("#tracks button").count(), what="the tracks are listed")


def test_a_click_brings_a_still_of_that_place(page):
    """The operator could look, and not look closer."""
    listed = lambda: re.search(r"\d", page.locator("#objects-title").inner_text())  # noqa: E731
    eventually(listed, what="a list has come: its clock tells when a still was taken")
    shows(page, after=shows(page) + 10)
    page.locator("#boxes").click(position={"x": 300, "y": 150})
    image = page.locator("#answer-picture")
    image.wait_for(state="visible")
    eventually(lambda: image.evaluate("one => one.naturalWidth") > 10, what="the still is shown")
    assert re.search(r" at \d\d:\d\d:\d\d, .* pixels of the camera", page.inner_text("#answer-text"))
    strip = page.locator("#stills img")
    eventually(strip.count, what="the strip shows stills")
    eventually(lambda: strip.first.evaluate("one => one.naturalWidth") > 4, what="its picture is loaded")
    shown, outlined = page.evaluate(_OUTLINE)  # at once: with the next still another is the first
    assert shown["x"] <= outlined["x"] + 2, "a box may end a little outside its crop"
    assert outlined["width"] <= shown["width"] + 2
    page.locator("#stills button").first.click()
    assert page.locator("#large").is_visible()
    page.keyboard.press("Escape")
    page.locator("#keyframe").click()


@pytest.mark.nightly
def test_a_second_viewer_joins_between_keyframes(flight, page):
    """Who comes later would wait for a keyframe, which may be a minute away."""
    shows(page)
    second = flight.page()
    began = shows(second)
    assert shows(page) - began < 100
    shows(second, after=began + 10)
    second.context.close()


@pytest.mark.nightly
def test_a_thin_browser_gets_single_pictures(flight):
    """A browser without Media Source would show nothing."""
    page = flight.page("rung=jpeg")
    first = shows(page)
    shows(page, after=first + 8)
    assert "single pictures" in page.inner_text("#rung")
    assert page.locator("#still-picture").evaluate("one => one.naturalWidth") == 640
    page.context.close()


def test_a_gap_greys_the_last_picture_and_ends_with_the_next(flight, page):
    """An operator would take an old picture for the one of now."""
    shows(page)
    page.locator("#gap").wait_for(state="hidden")
    flight.edge.process.send_signal(signal.SIGSTOP)
    try:
        page.locator("#stage.old").wait_for()
        # On a busy machine the page may have missed the ground before it misses the edge.
        missed = ("NO NEW PICTURE", "LINK LOST")
        eventually(lambda: page.inner_text("#standing").startswith(missed), what="it says so")
        last = frame(page)
        time.sleep(1.5)
    finally:
        flight.edge.process.send_signal(signal.SIGCONT)
    page.locator("#stage:not(.old)").wait_for()
    shows(page, after=last + 5)


@pytest.mark.nightly
def test_what_an_operator_must_see_stands_on_the_picture(flight, page):
    """He would scroll for it, or take a paused picture for the one of now."""
    for viewport in ({"width": 1440, "height": 900}, {"width": 390, "height": 844}):
        page.set_viewport_size(viewport)
        shows(page, after=frame(page))
        eventually(lambda: page.inner_text("#standing").startswith("live, "), what="it is live")
        eventually(lambda: page.inner_text("#recording") == "recording", what="it is recorded")
        eventually(lambda: "500 kbps" in page.inner_text("#on-link"), what="what the link carries")
        eventually(lambda: " so far, " in page.inner_text("#link-text"), what="not only the tracks of now")
        bottom = page.locator("#controls").evaluate("one => one.getBoundingClientRect().bottom")
        assert bottom <= viewport["height"], "sign, picture and playback, without scrolling"
    page.locator("#pause").click()
    eventually(lambda: page.inner_text("#standing").startswith("PAUSED "), what="it says so")
    page.locator("#now").click()
    eventually(lambda: page.inner_text("#standing").startswith("live, "), what="it is live again")


@pytest.mark.nightly
def test_an_edge_that_is_not_here_is_not_another(flight):
    """Another edge's picture would be shown to who asked for this one."""
    page = flight.page("edge=uav-9")
    page.locator("#absent").wait_for(state="visible")
    absent, wall = (page.locator(one).bounding_box()["y"] for one in ("#absent", "#wall"))
    assert absent < wall, "before all"
    assert page.inner_text("#absent").startswith("uav-9, which the address names, is not here")
    assert page.locator("#main").is_hidden()
    page.locator('.edge[data-edge="uav-1"]').click()
    shows(page)
    page.evaluate("location.hash = 'edge=uav-9'")
    page.locator("#absent").wait_for(state="visible")
    page.context.close()


@pytest.mark.nightly
def test_scrolling_commands_nothing(flight):
    """A wheel over the page would change the budget in flight, or a finger ask for a closer look."""
    page = flight.page()
    shows(page)
    sent: list[str] = []
    page.on("request", lambda one: sent.append(one.url) if one.method == "POST" else None)
    for selector in ("#budget", "#method"):
        before = page.locator(selector).input_value()
        page.locator(selector).focus()
        page.locator(selector).hover()
        page.mouse.wheel(0, 300)
        page.keyboard.press("ArrowDown")
        assert selector == "#method" or page.locator(selector).input_value() == before
    touch = page.context.new_cdp_session(page)
    box = page.locator("#boxes").bounding_box()
    x, y = box["x"] + box["width"] / 2, max(box["y"], 0) + 40
    for kind, at in (("touchStart", y), ("touchMove", y + 60), ("touchEnd", None)):
        points = [] if at is None else [{"x": x, "y": at}]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    time.sleep(0.5)
    assert sent == []
    page.context.close()


@pytest.mark.nightly
def test_steps_back_and_to_the_picture_of_now(page):
    """What was missed could not be looked at again."""
    first = shows(page)
    shows(page, after=first + 70)
    page.keyboard.press("Space")
    time.sleep(0.5)
    paused = frame(page)
    page.keyboard.press("ArrowLeft")
    eventually(lambda: frame(page) <= paused - 40, what="an earlier picture is shown")
    assert "ago" in page.inner_text("#age")
    page.keyboard.press("Shift+L")
    shows(page, after=paused + 5)
    page.locator("#why summary").press("Space")
    assert page.locator("#why[open]").count(), "a key opens what it stands on"


@pytest.mark.nightly
def test_an_event_leads_to_its_picture(page):
    """Who reads that something happened would search two minutes for it."""
    shows(page)
    page.locator("#budget").fill("400")
    page.locator("#budget-form button").click()
    event = page.locator("#events li", has_text="the budget is 400 kbps").get_by_role("button")
    event.wait_for()
    newest = shows(page, after=frame(page) + 20)
    event.click()
    eventually(lambda: frame(page) < newest - 10, what="the picture of that time")
    assert "ago" in page.inner_text("#age")


@pytest.mark.nightly
def test_the_page_fits_a_phone(flight):
    """Half of it would lie beside the screen."""
    page = flight.page(viewport={"width": 390, "height": 844}, color_scheme="light")
    shows(page)
    texts = "h2, #link-text, #failed, #events span"
    lengthen = f"document.querySelectorAll('{texts}').forEach(one => one.append('a'.repeat(60)))"
    page.evaluate(lengthen)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390, "with the longest names, too"
    page.context.close()


@pytest.mark.nightly
def test_nothing_jumps_while_the_picture_comes(flight):
    """Who wants to click on a car would hit a button that just moved there."""
    page = flight.page()
    shows(page)
    stills = page.locator("#stills li")
    eventually(stills.count, what="a still")
    page.locator("#stills").hover()
    newest = stills.first.locator("button")
    seen = newest.get_attribute("data-still")
    page.evaluate("""() => {
      window.shift = 0;
      window.moved = [];
      const note = (one) => {
        window.shift += one.value;
        window.moved.push(...one.sources.map(({ node }) => node?.id || node?.parentElement?.id || String(node)));
      };
      new PerformanceObserver((list) => list.getEntries().forEach(note)).observe({ type: "layout-shift" });
    }""")
    time.sleep(4)
    assert page.evaluate("window.shift") < 0.1, page.evaluate("window.moved")
    page.mouse.move(5, 5)
    # Not their number: a strip that is full stays as long as it is.
    eventually(lambda: newest.get_attribute("data-still") != seen, what="what came meanwhile")
    page.context.close()


def test_an_operator_sets_the_budget(flight):
    """A link that has become thin would want somebody at a command line."""
    page = flight.page()
    shows(page)

    def said(words: str) -> bool:
        return words in page.locator("#settings-text").text_content()

    page.evaluate("""() => {
      window.early = [];
      const text = (id) => document.getElementById(id).textContent;
      new MutationObserver(() => {
        if (/not in force/.test(text("settings-text"))) window.early.push(text("facts"));
      }).observe(document.body, {subtree: true, childList: true});
    }""")
    page.locator("#budget").fill("300")
    page.locator("#budget-form button").click()
    eventually(lambda: said("300 kbps is in force"), what="the edge flies with it")
    early = page.evaluate("window.early")
    assert early, "agreed before it is in force"
    assert not any("300 kbps" in one for one in early), "the budget of now stands alone"
    assert "300 kbps" in page.locator("#facts").text_content()
    page.locator("#budget").fill("10")
    page.locator("#budget-form button").click()
    refused = ("wait two seconds", "takes at least")
    eventually(lambda: any(map(said, refused)), what="the edge's refusal")
    page.reload()
    events = page.locator("#events li")
    eventually(lambda: "300 kbps" in events.first.inner_text(), what="the events that there were")
    assert sum("300 kbps" in one for one in events.all_inner_texts()) == 1, "each stands there once"
    page.context.close()
