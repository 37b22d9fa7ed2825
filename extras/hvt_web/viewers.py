"""The viewers: each has a bounded queue, every edge a memory for newcomers.

All of this lives in the thread of the web server's loop; `Hub.post` is the way in for others.
"""

from __future__ import annotations

import asyncio
import json
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hvt_common.runtime.process import lower_priority
from hvt_web.video.fmp4 import Fragment, Start
from hvt_web.video.pictures import RUNGS, THUMBNAIL, Made, Rung

_MOST_QUEUED = 400
_MOST_QUEUED_BYTES = 4 * 2**20
"""A viewer's limit: above, it loses pictures up to the next keyframe. Its first messages do not count."""
_MOST_TEXTS = 2000
_MOST_TEXT_BYTES = 4 * 2**20
"""Text is not dropped: a viewer with more of it unread is given up."""
_MOST_RETAINED_BYTES = 16 * 2**20
_MOST_RETAINED = 2000
"""Fragments since the last keyframe."""
_MOST_STILLS = 60
_MOST_PICTURES = 4 * _MOST_STILLS
"""A still has two; those of the list are there while as many newer stills come, for a slow browser asks late."""
_MOST_STILL_BYTES = 24 * 2**20
_MOST_NOTICES = 100
_MOST_LOADS = 240  # one a second


def text(kind: str, **content: Any) -> str:
    return json.dumps({"type": kind, **content}, separators=(",", ":"), ensure_ascii=False)


def packed(kind: str, payload: bytes, **content: Any) -> bytes:
    """A message with a payload: the length of its head in two bytes, the head as JSON, the payload."""
    head = text(kind, **content).encode()
    return len(head).to_bytes(2) + head + payload


class Viewer:
    """The queue of one connection, from ``address``. ``watches`` is an edge and a rung."""

    def __init__(self, address: str = "") -> None:
        self.address = address
        self.watches: tuple[str, Rung] | None = None
        self.wall = False
        self.hopeless = False
        """It takes nothing at all any more: nothing is kept for it, and `take` raises."""
        self.reason = ""
        """Reason of its end, in words for the page; at most 120 bytes."""
        self._queue: deque[tuple[str | bytes, bool]] = deque()
        self._bytes = 0
        self._texts = self._text_bytes = 0
        self._begun = self._begun_bytes = 0
        """Its first messages and their bytes, until it has taken them all."""
        self._waits_for_keyframe = False
        self._there = asyncio.Event()

    def put(self, message: str | bytes) -> None:
        """Queue a message that must not be lost."""
        if self._texts >= _MOST_TEXTS or self._text_bytes + len(message) > _MOST_TEXT_BYTES:
            self.give_up("it does not take what is sent")
        if self.hopeless:
            return
        self._texts += 1
        self._text_bytes += len(message)
        self._add(message, video=False)

    def begin_video(self, fragments: Sequence[bytes]) -> None:
        """Queue all fragments from a keyframe on; where there are none it waits for the next keyframe."""
        self._waits_for_keyframe = not fragments
        if self.hopeless:
            return
        self._begun += len(fragments)
        self._begun_bytes += sum(map(len, fragments))
        for one in fragments:
            self._add(one, video=True)

    def put_video(self, message: str | bytes, *, begins: bool) -> None:
        """Queue a message of the live picture; ``begins``: it can be used without those before it."""
        if self.hopeless or (self._waits_for_keyframe and not begins):
            return
        if self._full:
            self._drop_video()
            if not begins:
                self._waits_for_keyframe = True
                return
        self._waits_for_keyframe = False
        self._add(message, video=True)

    def put_picture(self, message: bytes) -> None:
        """Queue a thumbnail, which is no part of the live picture."""
        if not (self.hopeless or self._full):
            self._add(message, video=True)

    def give_up(self, reason: str) -> None:
        """It is closed, and told the reason: it takes nothing, or has to make room."""
        self.hopeless, self.reason = True, reason
        self._queue.clear()
        self._bytes = self._texts = self._text_bytes = 0
        self._there.set()

    def leave_video(self) -> None:
        """Forget the queued fragments of the watched picture."""
        self._drop_video()
        self._waits_for_keyframe = False

    @property
    def empty(self) -> bool:
        """Whether `take` would wait."""
        return not self._queue

    async def take(self) -> str | bytes:
        """The next message. Raises `ConnectionError` where the viewer is hopeless."""
        await asyncio.sleep(0)  # else all goes to a connection that is lost, and asyncio warns of each
        while not self._queue and not self.hopeless:
            self._there.clear()
            await self._there.wait()
        if self.hopeless:
            raise ConnectionError("the viewer takes nothing")
        message, video = self._queue.popleft()
        self._bytes -= len(message)
        if not self._queue:
            self._begun = self._begun_bytes = 0
        if not video:
            self._texts -= 1
            self._text_bytes -= len(message)
        return message

    @property
    def _full(self) -> bool:
        pending = len(self._queue) - self._texts - self._begun
        return pending >= _MOST_QUEUED or self._bytes - self._begun_bytes >= _MOST_QUEUED_BYTES

    def _add(self, message: str | bytes, *, video: bool) -> None:
        self._queue.append((message, video))
        self._bytes += len(message)
        self._there.set()

    def _drop_video(self) -> None:
        others = [one for one in self._queue if not one[1]]
        self._begun = self._begun_bytes = 0
        self._queue = deque(others)
        self._bytes = sum(len(message) for message, _ in others)


@dataclass(slots=True)
class _Stream:
    number: int
    start: tuple[str, bytes] | None = None
    fragments: list[bytes] = field(default_factory=list)
    size_bytes: int = 0


class StillPictures:
    """Pictures of stills by name, the newest ones."""

    def __init__(self) -> None:
        self._pictures: OrderedDict[tuple[str, str], tuple[bytes, str]] = OrderedDict()
        self._bytes = 0

    def add(self, still: str, which: str, picture: bytes, media_type: str) -> None:
        """Take one, in place of one of that name; the oldest make room."""
        before = self._pictures.pop((still, which), None)
        self._bytes -= 0 if before is None else len(before[0])
        self._pictures[still, which] = (picture, media_type)
        self._bytes += len(picture)
        while self._bytes > _MOST_STILL_BYTES or len(self._pictures) > _MOST_PICTURES:
            self._bytes -= len(self._pictures.popitem(last=False)[1][0])

    def get(self, still: str, which: str) -> tuple[bytes, str] | None:
        return self._pictures.get((still, which))


class EdgePage:
    """One edge as the page knows it."""

    def __init__(self, edge: str) -> None:
        self.edge = edge
        self.session: dict[str, Any] = {}
        self.stills: deque[str] = deque(maxlen=_MOST_STILLS)
        self.notices: deque[str] = deque(maxlen=_MOST_NOTICES)
        self.pictures = StillPictures()
        self.singles: dict[Rung, tuple[int, bytes]] = {}
        """The last JPEG and the last thumbnail, each with its frame."""
        self.overlay = ""  # the last boxes: of a silent edge no others come
        self.wanted: Mapping[Rung, int] = {}
        """Read by the thread that makes them; another number is another stream, which begins with a start."""
        self.streams: dict[Rung, _Stream] = {}
        self.newest = -1
        """The frame that came last; written by that thread."""
        self.last: Callable[[], None] = lambda: None
        """Make single pictures of it, where nobody looked as it came; for a thread of its own."""
        self.came = self.sought = -1
        """The newest frame at the last state, and the one of which single pictures were made so."""


class Hub:
    """Gives out the posts of the edges' feeds. Build it with the loop it will live in."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self.edges: dict[str, EdgePage] = {}
        self.viewers: set[Viewer] = set()
        self._streams = self._demands = 0
        self._state = ""
        self._loads: dict[str, deque[Sequence[float]]] = {}
        self._absent: set[str] = set()
        """Edges that the newest state does not have."""
        self._one_last = threading.Lock()

    def post(self, call: Callable[[], None]) -> None:
        """Have it done in the loop's thread; for any thread. After the loop's end nothing is done."""
        try:
            self._loop.call_soon_threadsafe(call)
        except RuntimeError:
            if not self._loop.is_closed():
                raise

    # From the feeds

    def begin(self, edge: EdgePage, session: dict[str, Any]) -> None:
        """A session begins: the streams of the former one are over."""
        if (before := self.edges.get(edge.edge)) is not None:  # who looks goes on seeing these
            edge.stills, edge.pictures = before.stills, before.pictures
        self.edges[edge.edge] = edge
        self._absent.discard(edge.edge)
        edge.session = session
        edge.streams.clear()
        self._to_all(text("session", **session))
        self._want(edge)

    def made(self, edge: EdgePage, made: Made, *, frame_index: int, captured_ms: float) -> None:
        """Give out a start, a fragment, a JPEG or a thumbnail, but not of a session that is over."""
        if self.edges.get(edge.edge) is not edge:
            return
        rung, item = made.rung, made.item
        about = {"edge": edge.edge, "frame": frame_index, "captured": round(captured_ms, 1)}
        if rung == THUMBNAIL:
            assert isinstance(item, bytes)
            message = packed("thumbnail", item, **about)
            edge.singles[rung] = (frame_index, message)
            for viewer in self.viewers:
                if viewer.wall:
                    viewer.put_picture(message)
            return
        if isinstance(item, Start):
            self._streams += 1
            stream = edge.streams[rung] = _Stream(self._streams)
            head = text("start", edge=edge.edge, rung=rung, codec=item.codec, stream=stream.number)
            stream.start = (head, packed("init", item.data, stream=stream.number))
            for viewer in self._watching(edge, rung):
                viewer.leave_video()
                self._put_thumbnails(viewer)
                self._join_stream(viewer, edge, rung)
        elif isinstance(item, Fragment):
            self._fragment(edge, rung, item, about)
        else:
            message = packed("jpeg", item, **about)
            edge.singles[rung] = (frame_index, message)
            for viewer in self._watching(edge, *(set(RUNGS) - edge.streams.keys())):
                viewer.put_video(message, begins=True)

    def overlay(self, edge: EdgePage, message: str) -> None:
        if self.edges.get(edge.edge) is not edge:
            return
        edge.overlay = message
        for viewer in self._watching(edge):
            viewer.put_video(message, begins=False)

    def still(self, edge: EdgePage, message: str, pictures: list[tuple[str, str, bytes, str]]) -> None:
        for still, which, picture, media_type in pictures:
            edge.pictures.add(still, which, picture, media_type)
        edge.stills.append(message)
        for viewer in self._watching(edge):
            viewer.put(message)

    def notice(self, edge: EdgePage, message: str) -> None:
        """An event, but not of a session that is over; the wall shows the last one of each edge."""
        if self.edges.get(edge.edge) is not edge:
            return
        edge.notices.append(message)
        self._to_all(message)

    def state(self, message: str, loads: Mapping[str, Sequence[float]], *, known: frozenset[str]) -> None:
        """Take the state of all edges; ``loads`` are the points of the plot, and are remembered for newcomers.

        An edge that is not ``known`` any more is forgotten, with its pictures, at the second state without it: one
        that has just come may not be in the first.
        """
        self._state = message
        absent = self.edges.keys() - known
        for edge in absent & self._absent:
            del self.edges[edge]
            self._loads.pop(edge, None)
            self._to_all(text("gone", edge=edge))
        self._absent = absent & self.edges.keys()
        for edge, load in loads.items():
            self._loads.setdefault(edge, deque(maxlen=_MOST_LOADS)).append(load)
        self._to_all(message)
        for page in self.edges.values():
            self._show_last(page)
            page.came = page.newest

    # From the viewers

    def join(self, viewer: Viewer) -> None:
        """A newcomer learns which edges there are."""
        self.viewers.add(viewer)
        for edge in self.edges.values():
            viewer.put(text("session", **edge.session))
            if edge.notices:
                viewer.put(edge.notices[-1])
        if self._state:
            viewer.put(self._state)

    def leave(self, viewer: Viewer) -> None:
        self.viewers.discard(viewer)
        self._want_all()

    def watch(self, viewer: Viewer, edge_name: str, rung: Rung) -> None:
        """Show it this edge from now on, beginning with the fragments of the present picture."""
        viewer.leave_video()
        self._put_thumbnails(viewer)
        viewer.watches = (edge_name, rung)
        viewer.put(text("loads", edge=edge_name, rows=list(self._loads.get(edge_name, ()))))
        edge = self.edges.get(edge_name)
        if edge is not None:
            for message in (*edge.notices, *edge.stills):
                viewer.put(message)
            self._join_stream(viewer, edge, rung)
        self._want_all()

    def show_wall(self, viewer: Viewer, *, shown: bool) -> None:
        """Send it thumbnails of all edges, or no more."""
        viewer.wall = shown
        self._put_thumbnails(viewer)
        self._want_all()

    # Within

    def _put_thumbnails(self, viewer: Viewer) -> None:
        # Those of all edges: of a silent one no other would come.
        for edge in self.edges.values() if viewer.wall else ():
            if THUMBNAIL in edge.singles:
                viewer.put_picture(edge.singles[THUMBNAIL][1])

    def _show_last(self, edge: EdgePage) -> None:
        # Frames have ceased and somebody looks: his page was empty, or of the time when somebody last looked.
        needed: set[Rung] = {"jpeg" if rung in RUNGS else rung for rung in edge.wanted.keys() - edge.streams}
        newest = edge.newest
        if newest in (-1, edge.sought) or newest != edge.came:
            return
        if all(edge.singles.get(rung, (-1,))[0] == newest for rung in needed):
            return
        edge.sought = newest

        def make() -> None:
            lower_priority()
            with self._one_last:
                edge.last()

        threading.Thread(target=make, name="hvt-web-last", daemon=True).start()

    def _join_stream(self, viewer: Viewer, edge: EdgePage, rung: Rung) -> None:
        stream = edge.streams.get(rung)
        frame, single = edge.singles.get("jpeg", (-1, b""))
        if stream is not None and stream.start is not None:
            for one in stream.start:
                viewer.put(one)
            viewer.begin_video(stream.fragments)
        elif frame == edge.newest >= 0:
            viewer.put_video(single, begins=True)
        if edge.overlay:
            viewer.put_video(edge.overlay, begins=False)

    def _fragment(self, edge: EdgePage, rung: Rung, item: Fragment, about: dict[str, Any]) -> None:
        stream = edge.streams.get(rung)
        if stream is None:
            return
        message = packed(
            "fragment",
            item.data,
            **about,
            stream=stream.number,
            media=round(item.media_s, 5),
            duration=round(item.duration_s, 5),
            key=item.keyframe,
        )
        if (
            item.keyframe
            or stream.size_bytes > _MOST_RETAINED_BYTES
            or len(stream.fragments) > _MOST_RETAINED
        ):
            stream.fragments.clear()
            stream.size_bytes = 0
        if item.keyframe or stream.fragments:
            stream.fragments.append(message)
            stream.size_bytes += len(message)
        for viewer in self._watching(edge, rung):
            viewer.put_video(message, begins=item.keyframe)

    def _watching(self, edge: EdgePage, *rungs: Rung) -> list[Viewer]:
        shown = [(edge.edge, rung) for rung in rungs or RUNGS]
        return [one for one in self.viewers if one.watches in shown]

    def _to_all(self, message: str) -> None:
        for viewer in self.viewers:
            viewer.put(message)

    def _want_all(self) -> None:
        for edge in self.edges.values():
            self._want(edge)

    def _want(self, edge: EdgePage) -> None:
        wanted: set[Rung] = {rung for rung in RUNGS if self._watching(edge, rung)}
        if any(viewer.wall for viewer in self.viewers):
            wanted.add(THUMBNAIL)
        for rung in edge.streams.keys() - wanted:
            del edge.streams[rung]  # the next one who looks begins another
        self._demands += 1
        edge.wanted = {rung: edge.wanted.get(rung, self._demands) for rung in wanted}
        self._show_last(edge)
