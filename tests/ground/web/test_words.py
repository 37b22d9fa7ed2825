"""What the page says of the picture: every sentence, as the page's own code makes it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from itertools import product
from pathlib import Path
from typing import Any

import pytest

import hvt_ground.web
from hvt_common.protocol.still_words import STILL_WORDS

STATIC = Path(hvt_ground.web.__file__).parent / "static"
NODE = shutil.which("node")
LIVE = {
    "connected": True, "refused": False, "goneMs": 0, "link": "up", "silentMs": 100, "chosen": True, "shown": True,
    "follows": True, "plays": True, "ageMs": 300, "sinceMs": 80, "periodMs": 100, "lastMs": 300, "lockstep": False,
}  # fmt: skip


def said(calls: list[tuple[str, list]]) -> list:
    """What functions of words.js return."""
    return ran(
        f"""
      import * as words from {json.dumps((STATIC / "words.js").as_uri())};
      const calls = {json.dumps(calls)};
      console.log(JSON.stringify(calls.map(([name, given]) => words[name](...given))));
    """
    )


def ran(script: str) -> Any:
    """What a module of JavaScript prints as JSON."""
    done = subprocess.run(
        [NODE, "--input-type=module", "-e", script], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.skipif(NODE is None, reason="needs node (Debian: apt install nodejs)")
def test_what_is_not_live_never_says_live():
    """An operator would act on a picture of a minute ago."""
    cases = [
        ({}, "live, 0.3 s"),
        ({"lockstep": True}, "lockstep: no age"),
        ({"ageMs": -40}, "live, 0.0 s"),
        ({"ageMs": -3_600_000}, "live, age not known"),
        ({"follows": False, "plays": False, "ageMs": 14_000}, "PAUSED 14 s"),
        ({"follows": False, "ageMs": 5_200}, "REPLAY 5.2 s"),
        ({"link": "lost", "silentMs": 8_000}, "LINK LOST 8 s"),
        ({"link": "ended", "ageMs": 61_000}, "ENDED, picture 61 s old"),
        ({"link": "ended", "shown": False}, "ENDED"),
        ({"connected": False, "goneMs": 9_000}, "NO GROUND 9 s"),
        ({"connected": False, "goneMs": 9_000, "refused": True}, "REFUSED 9 s"),
        ({"shown": False}, "waiting for a picture"),
        ({"shown": False, "lastMs": None}, "waiting for a picture"),
        ({"shown": False, "lastMs": 94_000}, "NO PICTURE 94 s"),
        ({"sinceMs": 4_000}, "NO NEW PICTURE 4 s"),
        ({"sinceMs": 1_400, "periodMs": 1_000}, "live, 0.3 s"),
    ]
    found = said([("standing", [LIVE | changed]) for changed, _ in cases])
    assert [one["words"] for one in found] == [words for _, words in cases]
    every = [
        dict(zip(("connected", "link", "shown", "follows", "sinceMs"), values, strict=True))
        for values in product((True, False), ("", "waiting", "up", "thin", "lost", "ended"), (True, False),
                              (True, False), (80, 30_000))
    ]  # fmt: skip
    for facts, one in zip(every, said([("standing", [LIVE | facts]) for facts in every]), strict=True):
        newest = facts["connected"] and facts["shown"] and facts["follows"] and facts["sinceMs"] < 1000
        assert one["live"] == (newest and facts["link"] not in ("lost", "ended")), facts
        assert one["words"].startswith("live") == one["live"]


@pytest.mark.skipif(NODE is None, reason="needs node (Debian: apt install nodejs)")
def test_what_is_unknown_is_not_said_to_be_nothing():
    """The list would say 0 tracks beside sixty cars whose boxes are half a second late."""
    found = said(
        [
            ("boxesWords", [None, 500]),
            ("boxesWords", [1400, 500]),
            ("boxesWords", [100, 500]),
            ("tracksTitle", [None, ""]),
            ("tracksTitle", [69, "boxes 1.4 s behind"]),
            ("tracksTitle", [0, ""]),
            ("recordingWords", [None]),
            ("recordingWords", [False]),
            ("connectionWords", [False, "the proxy takes the port off the header Host"]),
        ]
    )
    assert found == [
        "no boxes yet",
        "boxes 1.4 s behind",
        "",
        "Tracks: not known yet",
        "Tracks: 69 (boxes 1.4 s behind)",
        "Tracks: 0",
        "",
        "NOT RECORDED",
        "the ground refuses this page: the proxy takes the port off the header Host",
    ]


ELEMENTS = """
  const element = () => ({ dataset: {}, classList: { toggle() {} }, children: [], append() {}, insertBefore() {},
    setAttribute() {}, addEventListener() {} });
  globalThis.document = { createElement: element };
"""


@pytest.mark.skipif(NODE is None, reason="needs node (Debian: apt install nodejs)")
def test_an_edge_that_sends_no_picture_has_no_green_light():
    """A camera that died behind a link that works would look well on the wall."""
    found = ran(
        f"""
      {ELEMENTS}
      const {{ Wall }} = await import({json.dumps((STATIC / "wall.js").as_uri())});
      URL.createObjectURL = () => "";
      const wall = new Wall(element(), element(), () => {{}});
      const state = (link) => ({{ link, since: 100000, total: null, budget: null }});
      wall.thumbnail("uav-1", new Uint8Array(1), 100000);
      const seen = [["up", 103000], ["up", 112000], ["thin", 112000], ["lost", 112000]].map(([link, now]) => {{
        wall.state("uav-1", state(link), now);
        const {{ light, state: words }} = wall.card("uav-1");
        return [light.dataset.state, words.textContent];
      }});
      console.log(JSON.stringify(seen));
    """
    )
    assert found == [
        ["up", "up 3 s"],
        ["silent", "no picture 12 s"],
        ["silent", "no picture 12 s"],
        ["lost", "lost 12 s"],
    ]


@pytest.mark.skipif(NODE is None, reason="needs node (Debian: apt install nodejs)")
def test_the_plot_draws_no_line_over_what_is_not_known():
    """A minute without a link would be a straight line of bits that nobody sent, and the past would stand as now."""
    found = ran(
        f"""
      const lines = [];
      const drawn = (kind) => (x) => lines.push([kind, Math.round(x)]);
      const known = {{ measureText: () => ({{ width: 1 }}), moveTo: drawn("move"), lineTo: drawn("line") }};
      const context = new Proxy(known, {{ get: (one, name) => one[name] ?? (() => {{}}) }});
      globalThis.window = {{ devicePixelRatio: 1 }};
      globalThis.ResizeObserver = class {{ observe() {{}} }};
      globalThis.matchMedia = () => ({{ addEventListener() {{}} }});
      globalThis.document = {{}};
      globalThis.getComputedStyle = () => ({{ getPropertyValue: () => "" }});
      const {{ Plot }} = await import({json.dumps((STATIC / "plot.js").as_uri())});
      const plot = new Plot({{ clientWidth: 240, clientHeight: 100, getContext: () => context }});
      plot.fill("uav-1", [0, 1, 2, 60, 61].map((second) => [1000 * second, 10, 10, 20]));
      plot.show("uav-1");
      lines.length = 0;
      plot.now = 100000;
      plot.draw();
      console.log(JSON.stringify(lines.slice(0, 5)));
    """
    )
    assert found == [["move", 140], ["line", 141], ["line", 142], ["move", 200], ["line", 201]]


def test_the_page_shows_no_word_of_the_code():
    """``base_good`` and ``queue_full`` mean nothing to who flies."""
    code = {word for word in STILL_WORDS if "_" in word} | {"cooldown", "superseded"}
    for path in [*sorted(STATIC.glob("*.js")), STATIC / "index.html"]:
        found = code & set(re.findall(r"\w+", path.read_text()))
        assert not found, f"{path.name} says {found}"
    shown = (STATIC / "stills.js").read_text()
    assert "still.reason}" not in shown, "the reason is said in words"
