"""The player knows which picture is on the screen, as long as the browser can show it."""

import json
from pathlib import Path
from typing import Any

import hvt_web
from programs.node import needs_node, ran

PLAYER = Path(hvt_web.__file__).parent / "static" / "player.js"

pytestmark = needs_node


def played(script: str) -> Any:
    """What a script prints that has a ``player``, and ``take`` for a picture of it."""
    return ran(f"""
      globalThis.window = {{}};
      const {{ Player }} = await import({json.dumps(PLAYER.as_uri())});
      let begin = 0;
      let failed = false;
      const buffered = {{ length: 1, start: () => begin }};
      const does = {{ addEventListener() {{}}, requestVideoFrameCallback() {{}}, pause() {{}} }};
      const video = {{ ...does, buffered, currentTime: 4 }};
      const player = new Player(video, {{}}, null, () => {{ failed = true; }});
      const none = new Uint8Array(0);
      const take = (frame) => player.fragment({{ stream: -1, media: frame / 10, frame, captured: frame }}, none);
      {script}
    """)


def test_who_plays_on_after_a_long_pause_sees_the_time_of_the_picture():
    """The picture moved below the time and the boxes of the one at which somebody had paused minutes ago."""
    found = played("""
      for (let frame = 0; frame < 9000; frame++) take(frame);
      const found = [player.at(5).frame];
      begin = 890;
      take(9000);
      console.log(JSON.stringify([...found, player.at(890).frame, player.pictures.length]));
    """)
    assert found == [50, 8900, 101]


def test_a_pause_that_fills_the_browsers_memory_keeps_the_picture():
    """Who paused in the first ten seconds had single live pictures after some minutes, for good."""
    said = played("""
      const full = () => { throw new DOMException("", "QuotaExceededError"); };
      player.buffer = { buffered, updating: false, remove() {}, appendBuffer: full };
      player.pause();
      take(0);
      console.log(JSON.stringify([failed, player.live]));
    """)
    assert said == [False, False]


def test_who_pauses_single_pictures_plays_on_with_the_newest():
    """The button said Play, and the picture stood still for good."""
    assert played("player.pause(); player.play(); console.log(JSON.stringify(player.live));") is True


def test_pictures_that_come_faster_than_they_are_shown_leave_no_memory():
    """A page of single pictures on a slow machine took more and more memory, overnight gigabytes."""
    left = played("""
      let urls = 0;
      const held = new Set();
      URL.createObjectURL = () => (held.add(`blob:${++urls}`), `blob:${urls}`);
      URL.revokeObjectURL = (url) => held.delete(url);
      player.image.src = "";
      player.live = true;
      for (let frame = 0; frame < 9; frame++) player.jpeg({ frame, captured: frame }, none);
      console.log(JSON.stringify([...held]));
    """)
    assert left == ["blob:9"]
