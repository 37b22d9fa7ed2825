"""Viewers of one edge: newcomers begin in the middle, slow ones lose pictures, nobody waits for another."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator

import pytest

from hvt_web.video.fmp4 import Fragment, Start
from hvt_web.video.pictures import Made
from hvt_web.viewers import EdgePage, Hub, StillPictures, Viewer


def fragment(number: int, *, keyframe: bool = False, size: int = 10) -> Made:
    return Made("h264", Fragment(bytes(size), number / 10, 0.1, keyframe))


def kinds(viewer: Viewer) -> list[str]:
    """What waits in its queue, in order."""
    found = []
    while not viewer.empty:
        message = asyncio.run(viewer.take())
        if isinstance(message, bytes):
            message = message[2 : 2 + int.from_bytes(message[:2])].decode()
        said = json.loads(message)
        found.append(said["type"] + (f" {said['frame']}" if said["type"] == "fragment" else ""))
    return found


@pytest.fixture
def hub() -> Iterator[Hub]:
    loop = asyncio.new_event_loop()
    yield Hub(loop)
    loop.close()


def flown(hub: Hub, *, frames: int, keyframe_every: int) -> EdgePage:
    """An edge of which so many frames have come."""
    edge = EdgePage("uav-1")
    hub.begin(edge, {"edge": "uav-1"})
    hub.made(edge, Made("h264", Start("avc1.42c01f", b"start")), frame_index=0, captured_ms=0)
    for number in range(frames):
        hub.made(
            edge, fragment(number, keyframe=number % keyframe_every == 0), frame_index=number, captured_ms=0
        )
    return edge


def test_who_joins_between_keyframes_begins_at_the_last_one(hub):
    """The picture would stay black until the next keyframe, or be broken."""
    flown(hub, frames=26, keyframe_every=10)
    viewer = Viewer()
    hub.watch(viewer, "uav-1", "h264")
    assert kinds(viewer)[1:] == ["start", "init", *(f"fragment {number}" for number in range(20, 26))]


def test_who_joins_long_after_a_keyframe_begins_there_too(hub):
    """On a thin link keyframes come once a minute: a second viewer would see black until then."""
    edge = flown(hub, frames=900, keyframe_every=2000)
    viewer = Viewer()
    hub.join(viewer)
    hub.watch(viewer, "uav-1", "h264")
    hub.made(edge, fragment(900), frame_index=900, captured_ms=0)
    assert kinds(viewer)[4:] == [f"fragment {number}" for number in range(901)]


def test_who_joins_where_the_keyframe_is_no_longer_kept_waits_for_the_next(hub):
    """He would be shown a broken picture."""
    edge = flown(hub, frames=2003, keyframe_every=4000)
    viewer = Viewer()
    hub.join(viewer)
    hub.watch(viewer, "uav-1", "h264")
    for number in range(2003, 2006):
        hub.made(edge, fragment(number, keyframe=number == 2004), frame_index=number, captured_ms=0)
    assert kinds(viewer)[4:] == ["fragment 2004", "fragment 2005"]


def test_a_slow_viewer_goes_on_at_a_keyframe_and_loses_no_words(hub):
    """It would see a broken picture, or fill the memory of the ground."""
    edge = flown(hub, frames=1, keyframe_every=10)
    slow, quick = Viewer(), Viewer()
    for viewer in (slow, quick):
        hub.join(viewer)
        hub.watch(viewer, "uav-1", "h264")
    for number in range(1, 1005):
        made = fragment(number, keyframe=number % 100 == 0, size=20_000)
        hub.made(edge, made, frame_index=number, captured_ms=0)
        hub.notice(edge, json.dumps({"type": "notice"})) if number % 500 == 0 else None
        if number % 100 == 99:
            assert len([one for one in kinds(quick) if one.startswith("fragment")]) >= 99
    came = kinds(slow)
    assert came.count("notice") == 2
    frames = [int(one.split()[1]) for one in came if one.startswith("fragment")]
    assert len(frames) < 450
    assert frames[0] % 100 == 0
    assert frames == list(range(frames[0], 1005))


def test_a_thumbnail_is_no_keyframe(hub):
    """Who is slow would be shown a broken picture each time the wall is."""
    edge = flown(hub, frames=1, keyframe_every=1000)
    slow = Viewer()
    hub.join(slow)
    hub.show_wall(slow, shown=True)
    hub.watch(slow, "uav-1", "h264")
    for number in range(1, 1000):
        hub.made(edge, fragment(number), frame_index=number, captured_ms=0)
        if number % 10 == 0:
            hub.made(edge, Made("thumbnail", b"jpeg"), frame_index=number, captured_ms=0)
    assert not [one for one in kinds(slow) if one.startswith("fragment")]


def test_nothing_is_made_for_nobody(hub):
    """The ground would spend a processor on pictures that nobody looks at."""
    edge = flown(hub, frames=3, keyframe_every=10)
    viewer, other = Viewer(), Viewer()
    for one in (viewer, other):
        hub.join(one)
    assert not edge.wanted
    hub.watch(viewer, "uav-1", "h264")
    hub.watch(other, "uav-1", "jpeg")
    hub.show_wall(other, shown=True)
    assert set(edge.wanted) == {"h264", "jpeg", "thumbnail"}
    hub.leave(other)
    assert set(edge.wanted) == {"h264"}
    first = edge.wanted["h264"]
    hub.leave(viewer)
    hub.join(viewer)
    hub.watch(viewer, "uav-1", "h264")
    assert edge.wanted["h264"] != first, "a stream that nobody saw the start of would go on"
    hub.leave(viewer)
    assert not edge.wanted


def test_a_still_that_comes_again_takes_its_own_place():
    """One that shows several objects comes several times: in the end no picture at all would be there."""
    pictures = StillPictures()
    for number in range(4000):
        pictures.add(str(number // 4), "still", bytes(30_000), "image/jpeg")
    there = [number for number in range(1000) if pictures.get(str(number), "still") is not None]
    assert there[-1] == 999
    assert len(there) > 100


def test_the_pictures_of_a_list_are_there_while_newer_stills_come():
    """A browser asks for a picture when it has read the list: it got 404 for the oldest eight of them."""
    pictures = StillPictures()
    for number in range(120):
        for which in ("still", "base"):
            pictures.add(str(number), which, bytes(3_000), "image/jpeg")
    for number in range(60):
        assert pictures.get(str(number), "still") is not None, "it was in the list sixty stills ago"


def test_who_takes_nothing_at_all_is_given_up():
    """A browser that hangs would hold what is not dropped for ever."""
    viewer = Viewer()
    for _ in range(3000):
        viewer.put("words")
    assert viewer.hopeless
    with pytest.raises(ConnectionError):
        asyncio.run(viewer.take())


def test_that_a_viewer_has_gone_is_heard_between_two_messages():
    """Each tab that was closed on a weak radio left up to 300 lines of warnings in the log of the ground."""
    viewer, heard = Viewer(), []
    viewer.put("words")
    viewer.put("words")

    async def sent() -> None:
        await viewer.take()
        asyncio.get_running_loop().call_soon(heard.append, "lost")
        await viewer.take()
        assert heard == ["lost"]

    asyncio.run(sent())


def test_few_long_words_are_too_much_too():
    """Sixty viewers that hang would take gigabytes, two thousand messages each."""
    viewer = Viewer()
    for _ in range(1000):
        viewer.put("x" * 60_000)
    assert viewer.hopeless
    assert viewer.empty


def ceased(hub: Hub, edge: EdgePage, frame: int) -> None:
    """Its frames end with this one, of which single pictures can be made."""

    def last() -> None:
        for rung in ("jpeg", "thumbnail"):
            hub.made(edge, Made(rung, b"picture"), frame_index=frame, captured_ms=0)

    edge.newest, edge.last = frame, last
    for _ in range(2):
        hub.state('{"type": "state"}', {}, known=frozenset({"uav-1"}))
    made()


def made() -> None:
    """Wait for the pictures that are being made."""
    for one in threading.enumerate():
        if one.name == "hvt-web-last":
            one.join()


def test_who_comes_during_an_outage_sees_the_last_picture(hub):
    """The page was black for the very edge that was lost, or showed it as when somebody had last looked."""
    edge = flown(hub, frames=3, keyframe_every=10)
    hub.overlay(edge, '{"type": "overlay"}')
    assert not [one.name for one in threading.enumerate() if one.name == "hvt-web-last"], "nobody looks"
    ceased(hub, edge, 90)
    first, second = Viewer(), Viewer()
    for viewer in (first, second):
        hub.join(viewer)
        hub.show_wall(viewer, shown=True)
        hub.watch(viewer, "uav-1", "h264")
        made()
    assert {"jpeg", "overlay", "thumbnail"} < set(kinds(second))
    assert {"jpeg", "overlay", "thumbnail"} < set(kinds(first))
    hub.made(edge, Made("h264", Start("avc1.42c01f", b"start")), frame_index=91, captured_ms=0)
    edge.newest = 91
    third = Viewer()
    hub.watch(third, "uav-1", "hevc")
    assert "jpeg" not in kinds(third), "it is old by now"


def test_who_looks_again_at_an_edge_that_goes_on_sees_nothing_old(hub):
    """The picture of an hour ago would stand as the live one until the next keyframe."""
    edge = flown(hub, frames=3, keyframe_every=10)
    viewer = Viewer()
    hub.join(viewer)
    hub.watch(viewer, "uav-1", "h264")
    assert "fragment 0" in kinds(viewer), "of a stream that goes on the last keyframe"
    hub.leave(viewer)
    hub.join(viewer)
    hub.watch(viewer, "uav-1", "h264")
    hub.made(edge, fragment(3), frame_index=3, captured_ms=0)  # on its way when nobody looked any more
    assert not {"start", "fragment 3"} & set(kinds(viewer))
    ceased(hub, edge, 3)
    assert "jpeg" in kinds(viewer), "it is silent before another stream began"
    hub.made(edge, Made("h264", Start("avc1.42c01f", b"start")), frame_index=9, captured_ms=0)
    assert kinds(viewer)[:1] == ["start"]


def test_stills_of_the_flight_before_stay_where_an_edge_starts_again(hub):
    """The page lists them on, and those that it had not loaded yet would be broken pictures."""
    before = flown(hub, frames=3, keyframe_every=10)
    hub.still(before, "{}", [("000001-0", "still", b"picture", "image/jpeg")])
    flown(hub, frames=3, keyframe_every=10)
    now = hub.edges["uav-1"]
    assert (list(now.stills), now.pictures.get("000001-0", "still")) == (["{}"], (b"picture", "image/jpeg"))


def test_edges_that_the_ground_has_left_are_forgotten(hub):
    """Who invents names would fill its memory, and every wall; a newcomer is there before the state knows it."""
    for name in ("gone", "here"):
        hub.begin(EdgePage(name), {"edge": name})
    hub.state("{}", {"gone": (0, 1.0, 1.0, 1.0)}, known=frozenset({"gone", "here"}))
    hub.state("{}", {}, known=frozenset({"here"}))
    hub.begin(EdgePage("new"), {"edge": "new"})
    assert hub.edges.keys() == {"gone", "here", "new"}
    hub.state("{}", {}, known=frozenset({"here"}))
    assert hub.edges.keys() == {"here", "new"}
