"""Viewers of one edge: newcomers begin in the middle, slow ones lose pictures, nobody waits for another."""

import asyncio
import json
import threading
from collections.abc import Container, Iterator

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


def flown(hub: Hub, *, frames: int, keyframes: Container[int] = (0,)) -> EdgePage:
    """An edge of which so many frames have come."""
    edge = EdgePage("uav-1")
    hub.begin(edge, {"edge": "uav-1"})
    hub.made(edge, Made("h264", Start("avc1.42c01f", b"start")), frame_index=0, captured_ms=0)
    for number in range(frames):
        hub.made(edge, fragment(number, keyframe=number in keyframes), frame_index=number, captured_ms=0)
    return edge


@pytest.mark.parametrize(
    ("frames", "keyframes", "more", "shown"),
    [
        (26, range(0, 26, 10), 0, ["start", "init", *range(20, 26)]),
        (900, [0], 1, ["start", "init", *range(901)]),  # on a thin link keyframes come once a minute
        (2003, [0, 2004], 3, ["start", "init", 2004, 2005]),  # its keyframe is no longer kept
    ],
)
def test_who_joins_begins_at_a_keyframe(hub, frames, keyframes, more, shown):
    """The picture would stay black until the next keyframe, or be broken."""
    edge = flown(hub, frames=frames, keyframes=keyframes)
    viewer = Viewer()
    hub.join(viewer)
    hub.watch(viewer, "uav-1", "h264")
    for number in range(frames, frames + more):
        hub.made(edge, fragment(number, keyframe=number in keyframes), frame_index=number, captured_ms=0)
    assert kinds(viewer)[2:] == [f"fragment {one}" if isinstance(one, int) else one for one in shown]


def test_a_slow_viewer_goes_on_at_a_keyframe_and_loses_no_words(hub):
    """It would see a broken picture, or fill the memory of the ground."""
    edge = flown(hub, frames=1)
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
    edge = flown(hub, frames=1)
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
    edge = flown(hub, frames=3)
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


def test_the_pictures_of_stills_stay_for_as_long_as_they_are_asked_for():
    """One that shows several objects comes several times: in the end no picture at all would be there.

    A browser asks for a picture when it has read the list: it got 404 for the oldest eight of them.
    """
    pictures, listed = StillPictures(), StillPictures()
    for number in range(4000):
        pictures.add(str(number // 4), "still", bytes(30_000), "image/jpeg")
    there = [number for number in range(1000) if pictures.get(str(number), "still") is not None]
    assert (there[-1], len(there) > 100) == (999, True)
    for number in range(120):
        for which in ("still", "base"):
            listed.add(str(number), which, bytes(3_000), "image/jpeg")
    assert all(listed.get(str(number), "still") for number in range(60)), "in the list sixty stills ago"


@pytest.mark.parametrize(("times", "words"), [(3000, "words"), (1000, "x" * 60_000)])
def test_who_takes_nothing_at_all_is_given_up(times, words):
    """A browser that hangs would hold what is not dropped for ever: sixty of them would take gigabytes."""
    viewer = Viewer()
    for _ in range(times):
        viewer.put(words)
    assert (viewer.hopeless, viewer.empty) == (True, True)
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
    edge = flown(hub, frames=3)
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
    edge = flown(hub, frames=3)
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
    before = flown(hub, frames=3)
    hub.still(before, "{}", [("000001-0", "still", b"picture", "image/jpeg")])
    flown(hub, frames=3)
    now = hub.edges["uav-1"]
    assert (list(now.stills), now.pictures.get("000001-0", "still")) == (["{}"], (b"picture", "image/jpeg"))


def test_edges_that_the_ground_has_left_are_forgotten(hub):
    """Who invents names would fill its memory, and every wall; a newcomer is there before the state knows it."""
    viewer = Viewer()
    hub.join(viewer)
    gone, here = EdgePage("gone"), EdgePage("here")
    for page in (gone, here):
        hub.begin(page, {"edge": page.edge})
    hub.state('{"type": "state"}', {"gone": (0, 1.0, 1.0, 1.0)}, known=frozenset({"gone", "here"}))
    hub.state('{"type": "state"}', {}, known=frozenset({"here"}))
    hub.begin(EdgePage("new"), {"edge": "new"})
    assert hub.edges.keys() == {"gone", "here", "new"}
    hub.state('{"type": "state"}', {}, known=frozenset({"here"}))
    assert hub.edges.keys() == {"here", "new"}
    assert kinds(viewer)[-2:] == ["gone", "state"], "an open page had it for as long as it stayed open"
    hub.notice(gone, '{"type": "notice"}')
    assert kinds(viewer) == [], "its last event brought it back"
