"""What the page says of the picture: every sentence, as the page's own code makes it."""

import ast
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest

import hvt_ground
import hvt_web
from hvt_common.protocol.edge_words import STILL_WORDS
from programs.node import needs_node, ran

ROOT = Path(__file__).parents[3]
STATIC = Path(hvt_web.__file__).parent / "static"
WORDS = json.dumps((STATIC / "words.js").as_uri())
LIVE = {
    "connected": True, "refused": False, "goneMs": 0, "link": "up", "silentMs": 100, "chosen": True, "shown": True,
    "follows": True, "plays": True, "ageMs": 300, "sinceMs": 80, "periodsMs": [100], "lastMs": 300, "lockstep": False,
}  # fmt: skip


def said(calls: list[tuple[str, list]]) -> list:
    return ran(f"""
      import * as words from {WORDS};
      const calls = {json.dumps(calls)};
      console.log(JSON.stringify(calls.map(([name, given]) => words[name](...given))));
    """)


@needs_node
def test_what_is_not_live_never_says_live():
    """An operator would act on a picture of a minute ago."""
    cases = [
        ({}, "live, 0.3 s"),
        ({"lockstep": True}, "lockstep: no age"),
        ({"ageMs": 5_400}, "LATE, 5.4 s old"),
        ({"ageMs": 2_400, "sinceMs": 900, "periodsMs": [1_000]}, "LATE, 2.4 s old"),
        ({"ageMs": -40}, "live, 0.0 s"),
        ({"ageMs": -3_600_000}, "live, age not known"),
        ({"follows": False, "plays": False, "ageMs": 14_000}, "PAUSED 14 s"),
        ({"follows": False, "ageMs": 5_200}, "REPLAY 5.2 s"),
        ({"link": "lost", "silentMs": 8_000}, "LINK LOST 8 s"),
        ({"link": "ended", "ageMs": 61_000}, "ENDED, picture 61 s old"),
        ({"link": "ended", "ageMs": -400}, "ENDED, picture 0.0 s old"),
        ({"follows": False, "plays": False, "ageMs": -400}, "PAUSED 0.0 s"),
        ({"link": "ended", "shown": False}, "ENDED"),
        ({"connected": False, "goneMs": 9_000}, "NO GROUND 9 s"),
        ({"connected": False, "goneMs": 9_000, "refused": True}, "REFUSED 9 s"),
        ({"shown": False}, "waiting for a picture"),
        ({"shown": False, "lastMs": None}, "waiting for a picture"),
        ({"shown": False, "lastMs": 94_000}, "NO PICTURE 94 s"),
        ({"ageMs": 27_000, "sinceMs": 400}, "NO NEW PICTURE 27 s"),
        ({"sinceMs": 4_000}, "NO NEW PICTURE 4 s"),
        ({"sinceMs": 1_400, "periodsMs": [1_000, 900, 1_100]}, "live, 0.3 s"),
        ({"sinceMs": 1_400, "periodsMs": [100, 3_000, 200]}, "NO NEW PICTURE 1 s"),
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


SENTENCES: dict[str, list[tuple[list, Any]]] = json.loads(
    Path(__file__).with_name("sentences.json").read_text(encoding="utf-8")
)
"""By name in words.js: what it is given, and what an operator then reads. A new one is written here, and read."""


@needs_node
def test_every_sentence_of_the_page_is_read():
    """A word of the code, a hole or a number that nobody knows would stand before who flies."""
    found = ran(f"""
      import * as words from {WORDS};
      const given = {json.dumps({name: [one for one, _ in cases] for name, cases in SENTENCES.items()})};
      const say = (one, cases) => (typeof one === "function" ? cases.map((args) => one(...args)) : [one]);
      const said = Object.entries(words).map(([name, one]) => [name, say(one, given[name] ?? [])]);
      console.log(JSON.stringify(Object.fromEntries(said)));
    """)
    assert found == {name: [said for _, said in cases] for name, cases in SENTENCES.items()}
    for said in texts(found):
        assert not re.search(r"undefined|null|NaN|\[object|\$\{|_|  ", said), said


@needs_node
def test_boxes_go_on_with_their_objects_until_the_next_list_comes():
    """The picture is on the screen before its list: a car of 12 px a frame has left its box by then."""
    smaller = {"id": 1, "box": [2, 1, 18, 9]}  # it grows, and may do so no longer
    before = {"frame": 0, "captured": 1000, "tracks": [smaller]}
    parked = {"id": 2, "box": [50, 50, 60, 60]}
    found = {"frame": 5, "captured": 1300, "tracks": [{"id": 1, "box": [60, 0, 80, 10]}, parked]}
    boxes = ran(f"""
      import {{ carried }} from {json.dumps((STATIC / "boxes.js").as_uri())};
      const [found, before] = {json.dumps([found, before])};
      const at = (list, captured) => carried(found, list, captured).map(({{ box }}) => box);
      const times = [1500, 2100].map((captured) => at(before, captured));
      console.log(JSON.stringify([...times, at(before, 1300), at(null, 1500), at(found, 1500)]));
    """)
    seen = [[60, 0, 80, 10], parked["box"]]
    furthest = [[180, 0, 200, 10], parked["box"]]
    assert boxes == [[[100, 0, 120, 10], parked["box"]], furthest, seen, seen, seen], "it never goes back"


@needs_node
def test_a_box_goes_out_of_the_picture_with_its_object():
    """Its name would stand at the rim, and a line where a box was turned inside out."""
    lists = [
        {
            "frame": frame,
            "captured": 40 * frame,
            "tracks": [{"id": row, "box": box} for row, box in enumerate(boxes)],
        }
        for frame, boxes in (
            (0, [[0, 0, 30, 9], [50, 0, 64, 9], [40, 0, 50, 9]]),
            (5, [[0, 0, 10, 9], [62, 0, 64, 9], [45, 0, 55, 9]]),
        )
    ]
    drawn = ran(f"""
      import {{ Boxes }} from {json.dumps((STATIC / "boxes.js").as_uri())};
      const overlays = new Map({json.dumps([[one["frame"], one] for one in lists])});
      const about = {{ overlays, frame: 9, captured: 360, size: [64, 36] }};
      const boxes = Object.assign(Object.create(Boxes.prototype), about);
      console.log(JSON.stringify(boxes.current().tracks));
    """)
    assert drawn == [{"id": 2, "box": [49, 0, 59, 9]}]


def texts(found: Any) -> list[str]:
    if isinstance(found, dict):
        return [text for one in found.values() for text in texts(one)]
    return [text for one in found for text in texts(one)] if isinstance(found, list) else [str(found)]


_NO_TEXT = {
    "`${letter}px system-ui, sans-serif`",
    "`${11 * ratio}px system-ui, sans-serif`",
    '"(prefers-color-scheme: light)"',
    '"button, input, select, summary"',
    '`${track.doubted ? "doubted" : ""} ${track.read ? "read" : ""}`',
    '`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`',
    '`video/mp4; codecs="${codec}"`',
    '`video/mp4; codecs="${start.codec}"`',
    "`#${new URLSearchParams({ edge, ...(wanted ? { rung: wanted } : {}) })}`",
    "`calc(min(72vh, max(15rem, 100vh - 24.5rem)) * ${width / height})`",
    "`${page}#${new URLSearchParams({ edge })}`",
    "`${width} / ${height}`",
    '" · "',
    '" "',
}
"""Fonts, selectors, addresses and the like."""
_SHOWN = re.compile(
    r'(?:\.(?:textContent|title|alt|innerHTML) = |"aria-label", |confirm\(|tell\()(?:`|"[^"])'
)


def test_no_text_of_the_page_is_written_elsewhere():
    """It would be read by nobody before an operator does."""
    parts = re.compile(r'"(?:[^"\\\n]|\\.)*"|`(?:[^`\\]|\\.)*`|//[^\n]*|/\*.*?\*/', re.DOTALL)
    for path in sorted(STATIC.glob("*.js")):
        if path.name == "words.js":
            continue
        literals = [one for one in parts.findall(path.read_text()) if one[0] in '"`']
        said = [one for one in literals if re.search(r"\s|[^\x00-\x7f]", one) and one not in _NO_TEXT]
        assert not said, f"{path.name}: {said} belongs into words.js"
        assert not _SHOWN.search(path.read_text()), path.name


ELEMENTS = """
  const element = () => ({ dataset: {}, classList: { toggle() {} }, children: [], append() {}, insertBefore() {},
    remove() {}, setAttribute() {}, addEventListener() {}, querySelector: () => null });
  globalThis.document = { createElement: element };
"""


@needs_node
def test_an_edge_that_sends_no_picture_has_no_green_light():
    """A camera that died behind a link that works would look well on the wall."""
    found = ran(f"""
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
      wall.state("uav-1", {{ ...state("up"), total: 2e5, budget: 5e5 }}, 112000);
      wall.refresh(112000, new Set(["uav-2"])); // a ground that was restarted tells of that one alone
      const {{ light, bar }} = wall.card("uav-1");
      wall.leave("uav-1");
      const left = [wall.cards.size, wall.nobody.hidden];
      console.log(JSON.stringify([...seen, [light.dataset.state, bar.ariaValueText], left]));
    """)
    silent = ["silent", "no picture 12 s"]
    assert found == [
        ["up", "up 3 s"],
        silent,
        silent,
        ["lost", "lost 12 s"],
        ["unknown", "200 kbps of 500 kbps"],
        [0, False],
    ]


@needs_node
def test_edges_that_come_later_do_not_push_the_chosen_one_off_the_screen():
    """On a phone, which shows two, the one that the address names was nowhere; and uav-10 stood before uav-2."""
    found = ran(f"""
      {ELEMENTS}
      const {{ Wall }} = await import({json.dumps((STATIC / "wall.js").as_uri())});
      const cards = [];
      document.createElement = () => ({{
        ...element(),
        scrollIntoView() {{}},
        setAttribute(name, value) {{ this[name] = value; }},
        get offsetLeft() {{ return 100 * cards.indexOf(this); }},
      }});
      const root = {{ ...element(), scrollLeft: 0 }};
      root.querySelector = () => cards.find((one) => one["aria-current"] === "true");
      root.insertBefore = (card, other) => cards.splice(other ? cards.indexOf(other) : cards.length, 0, card);
      const wall = new Wall(root, {{}}, () => {{}});
      wall.card("uav-2");
      wall.mark("uav-2");
      for (const name of ["uav-10", "uav-1", "uav-0"]) wall.card(name);
      console.log(JSON.stringify([cards.map((one) => one.dataset.edge), root.scrollLeft]));
    """)
    assert found == [["uav-0", "uav-1", "uav-2", "uav-10"], 200]


@needs_node
def test_the_plot_draws_no_line_over_what_is_not_known():
    """A minute without a link would be a straight line of bits that nobody sent, and the past would stand as now."""
    found = ran(f"""
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
    """)
    assert found == [["move", 140], ["line", 141], ["line", 142], ["move", 200], ["line", 201]]


@needs_node
def test_names_give_way_and_what_was_not_seen_in_this_picture_is_faint():
    """On a crowded car park nobody could read a name, or see a car under one; old boxes would pass for new ones."""
    found = ran(f"""
      let drawn = {{ boxes: [], names: [] }};
      const known = {{ measureText: (text) => ({{ width: 6 * text.length }}),
        strokeRect(...box) {{ drawn.boxes.push([...box, this.globalAlpha, this.strokeStyle]); }},
        fillText(text, x, y) {{ drawn.names.push([text, x, y]); }},
        clearRect() {{}}, fillRect() {{}}, setLineDash() {{}} }};
      globalThis.window = {{ devicePixelRatio: 1 }};
      globalThis.ResizeObserver = class {{ observe() {{}} }};
      const {{ Boxes }} = await import({json.dumps((STATIC / "boxes.js").as_uri())});
      const canvas = {{ clientWidth: 640, clientHeight: 360, getContext: () => known, addEventListener() {{}} }};
      const boxes = new Boxes(canvas, () => {{}});
      boxes.size = [640, 360];
      const seen = (looked, tracks) => {{
        boxes.add({{ frame: 1, captured: 1000, looked, tracks, colours: {{ car: "#56b4e9", van: "#f0ad1e" }} }});
        drawn = {{ boxes: [], names: [] }};
        boxes.show({{ frame: 1, captured: 1000 }});
        return structuredClone({{ ...drawn, behind: boxes.behind() }});
      }};
      const track = (id, x, y, name = "car") => ({{ id, name, sureness: 0.9, box: [x, y, x + 30, y + 20] }});
      const crowd = [...Array(60).keys()].map((id) => track(id, 10 + 36 * (id % 15), 60 + 24 * Math.floor(id / 15)));
      const out = {{ crowd: seen(1000, crowd), old: seen(400, crowd.slice(0, 1)) }};
      boxes.filter("van", false);
      out.filtered = seen(1000, [track(1, 10, 50), track(2, 200, 50, "van")]);
      boxes.toggle(false);
      out.none = seen(1000, crowd);
      console.log(JSON.stringify(out));
    """)
    crowd, old = found["crowd"], found["old"]
    assert len(crowd["boxes"]) == 60
    assert 10 < len(crowd["names"]) < 60
    middles = [(x + w / 2, y + h / 2) for x, y, w, h, _, _ in crowd["boxes"]]
    for text, x, y in crowd["names"]:  # 12 px letters over 6 px a letter
        left, top, right = x - 3, y - 12, x + 6 * len(text) + 3
        assert not [one for one in middles if left < one[0] < right and top < one[1] < top + 16.2]
    assert [one[4:] for one in old["boxes"]] == [[0.5, "#56b4e9"]]
    assert old["behind"] == 600
    assert [one[4:] for one in found["filtered"]["boxes"]] == [[1, "#56b4e9"]]
    assert found["none"]["boxes"] == found["none"]["names"] == []


def test_the_page_shows_no_word_of_the_code():
    """``base_good`` and ``queue_full`` mean nothing to who flies."""
    code = {word for word in STILL_WORDS if "_" in word} | {"cooldown", "superseded"}
    for path in [*sorted(STATIC.glob("*.js")), STATIC / "index.html"]:
        found = code & set(re.findall(r"\w+", path.read_text()))
        assert not found, f"{path.name} says {found}"


EVENTS = {
    "the ground has asked for a keyframe",
    "… lost: the ground waits for a keyframe",
    "from now on the budget is …, and the method …",
    "… from the outage at … UTC arrived",
    "… of this session arrived after it had ended",
    "the session failed: …",
    "the edge did not send these stills: …",
    "the flight has ended",
    "this session has ended",
    "the camera's clock is … s off: ages count from the arrival of pictures, and delays are not known",
    "the pose is stale: nothing is placed on the ground until there is a new one",
    "there is a pose again",
    "… lines were left out here: the edge gave rise to too many",
    "still … is asked for again: the picture it builds on did not come",
    "still … is damaged: it is not shown",
}
"""Every text of an event that the ground makes; it passes on what an edge says of its settings in flight."""
REFUSALS = {
    "unknown host, or a reverse proxy without --web-proxy",
    "give the link that hvt-ground showed at its start",
    "the proxy of … has to pass that host on and say in … who is viewer or operator",
    (
        "the proxy takes the port off the header Host, so that this looks like another site: have it pass Host as "
        "the browser sent it (nginx: proxy_set_header Host $http_host)"
    ),
    "this comes from another site",
    "only an operator may do this",
    "too many viewers",
    "too many viewers: one from another address took this place",
    "it does not take what is sent",
    "there is no such picture any more",
    "there is no such edge",
    "there is nothing here",
    "too much was sent",
    "this is no JSON",
    "this is no JSON object",
    "give kbps, from 1 on, or method, such as M5",
    "box is no [x1, y1, x2, y2] in pixels of the picture",
    "frame is no whole number",
    "… requests are under way: wait for one of them",
    "the link is not open yet",
}
"""Every answer of the page's server that is no picture."""
ANSWERS = {
    "a box takes x, y, w and h, all four",
    "a still is of a track or of a box, not of both",
    "a still is of a frame or of a time, not of both",
    "that session has ended",
    "this edge does not serve …",
    "too many requests: at most … a second are served",
    "R0 codes the video in another way from the first frame on: start the edge with it",
    "this edge stores nothing while its link is away (--store 0)",
    "nothing is stored that was not sent",
    "… is too little for …: it takes at least …",
    "…: … is a whole number from … to …, not …",
    "…: … is missing",
    "…: … is a word, not …",
    "… takes no …",
    "the rates were changed a moment ago: wait two seconds",
    "no frame was looked at yet, or none is kept (--ring)",
    "this edge sends video alone and followed no objects; it does from now on: request again in a second",
    "… requested stills are pending already: try again later",
    "nothing is known of a still of the number …",
    "it could not be coded (…)",
    "there is no track … at frame …: the edge's own tracks there are …",
    "… is not held: frames go back … s",
    "box …,…,…,… is not inside the frame of …x… source pixels (x,y,w,h)",
    "box …,…,…,… is too small: … pixels a side at least",
    "frame … is yet to come: the newest is …",
    "track … is outside the picture at frame …",
    "… is not a picture that can be written: name it …",
    "… accepted the still, but it did not come within … s: …",
    "… refuses: …",
    "… cannot be written (…): name a file that can",
    "… sent a still that cannot be decoded: …",
    "… has ended: the still does not come",
    "…: …",
    "the answer of … cannot be used: …",
    "two edges call themselves …, and both have answered: stop one of them, or start it with an --edge-id of its own",
    (
        "the session of … that was asked does not answer, and another one does: it was started anew, or two edges "
        "have one name"
    ),
}
"""Every answer of an edge to a command, and what the ground says where there is none that it can use."""
MORE_ANSWERS = {
    "edge/hvt_edge/operating.py": {
        "the last keyframe came … s ago, after many others: ask again in … s",
        (
            "the camera's own video is sent (--encoder passthrough), and it makes no keyframe on request: the next "
            "comes by itself, one each … s or so"
        ),
    },
    "edge/hvt_edge/stills/on_demand.py": {
        "the edge has ended",
        "no ground receives the video of this edge: until one does, stills are stored",
        "the keyframe that goes before it had no room",
        "those that were requested before it had not gone",
        "in … s …",
        "the link was never free for it",
        "the budget had no room for it",
    },
    "edge/hvt_edge/stills/requested_coding.py": {"the video already shows it as well as the source does"},
    "ground/hvt_ground/control.py": {
        "edge … does not answer: is it flying, and does this link reach it?…",
        "the edge is not there any more: it has ended, or its link is down",
        "the link is full, or has lost it",
    },
}
"""Those that are put into a name before, by the module that makes them."""


def test_every_answer_to_a_command_is_read():
    """What the edge says to an operator comes from many places too: each text stands here, and was read."""
    found = {text for path in ROOT.joinpath("edge").rglob("*.py") for text in given(path, {"RefusedError"})}
    found |= set(given(ROOT / "ground/hvt_ground/control.py", {"RefusedError", "UserError", "telling"}))
    assert found == ANSWERS
    for name, said in MORE_ANSWERS.items():
        assert said <= set(sentences(ROOT / name)), name
    assert not any("_" in one for one in ANSWERS | EVENTS)


def test_every_event_and_every_refusal_is_read():
    """What the ground says on the page comes from many places: each text stands here, and was read."""
    ground, page = Path(hvt_ground.__file__).parent, STATIC.parent
    found = {text for folder in (ground, page) for path in folder.rglob("*.py") for text in noted(path)}
    assert found == EVENTS
    web = [page / f"{name}.py" for name in ("access", "site", "requests", "viewers", "server")]
    said = {text for path in web for text in sentences(path)}
    assert said >= REFUSALS
    answers = {
        text
        for path in web
        for text in given(path, {"PlainTextResponse", "BadRequestError", "BusyError", "give_up"})
    }
    assert answers <= REFUSALS


def noted(path: Path) -> Iterator[str]:
    """The texts of events that a module makes."""
    for call in calls(path):
        name = called(call)
        if name in ("note", "_note") and len(call.args) == 2:  # level, text
            yield from spoken(call.args[1])
        elif name in ("Notice", "_notice"):
            yield from spoken(call.args[-1])
    for node in ast.walk(ast.parse(path.read_text())):  # what was put into a name before
        if isinstance(node, ast.Assign) and path.stem == "session":
            yield from (text for text in spoken(node.value) if "left out here" in text)


def given(path: Path, names: set[str]) -> Iterator[str]:
    """The texts that a module gives to calls of these names."""
    for call in calls(path):
        if called(call) == "telling" in names:
            yield "…".join(text for one in call.args for text in spoken(one))
        elif called(call) in names and call.args:
            yield from spoken(call.args[0])


def sentences(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.expr):
            yield from spoken(node)


def calls(path: Path) -> Iterator[ast.Call]:
    return (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))


def called(call: ast.Call) -> str:
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def spoken(node: ast.expr) -> Iterator[str]:
    """The texts of a constant, an f-string, or one of two; what is filled in is an ellipsis."""
    match node:
        case ast.Constant(value=str(text)):
            yield text
        case ast.JoinedStr(values=values):
            yield "".join(str(one.value) if isinstance(one, ast.Constant) else "…" for one in values)
        case ast.IfExp(body=body, orelse=other):
            yield from (*spoken(body), *spoken(other))


# What browsers load.


@pytest.mark.skipif(shutil.which("tsc") is None, reason="needs tsc (Debian: apt install node-typescript)")
def test_the_types_of_the_page_hold():
    """A message that lost a field would show as a page that stands still, in some browser, some day."""
    options = ("--noEmit", "--allowJs", "--checkJs", "--strict", "--target", "es2022", "--module", "es2022")
    checked = subprocess.run(
        ["tsc", *options, "--lib", "es2022,dom,dom.iterable", STATIC / "main.js"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stdout


def test_commands_are_offered_to_nobody_of_whom_it_is_not_known_that_he_may_give_them():
    """A viewer had all the buttons, and they did nothing: a style by name beat the one that hid them by role."""
    assert '<fieldset id="commands" hidden>' in (STATIC / "index.html").read_text()


def test_every_file_comes_from_the_ground():
    """A page at the end of a thin link, or in a closed network, would wait for the rest of the world."""
    names = {path.name for path in STATIC.iterdir()}
    assert {"index.html", "main.js", "page.css"} <= names
    for path in STATIC.iterdir():
        elsewhere = [
            line
            for line in path.read_text().splitlines()
            if ("://" in line and "http://www.w3.org/2000/svg" not in line)
            or re.search('["`]/[a-z]', line)  # a proxy may show the page below a path
        ]
        assert not elsewhere, path.name
