"""Reads a recording back, for tests: what a viewer would show at a frame, as plain values."""

import pickle
import subprocess
import sys
import warnings
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rerun.chunk import Chunk, RrdReader

from hvt_ground.events import Event
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings

STATIC = -(1 << 62)


@dataclass(frozen=True)
class ReadBox:
    """One track as the recording tells it."""

    box_px: tuple[float, float, float, float]
    class_before: str
    class_after: str
    confidence_pct: int
    refined: bool
    reported: bool
    origin: int | None
    label: str
    """Empty where there is none."""
    doubted: bool = False
    word: str = ""
    """What the viewer calls it."""


def settings(path: Path | None, **changes: Any) -> RecorderSettings:
    small = RecorderSettings(path, "uav-1", "00ff", (320, 192), 15.0, 400_000.0, {"method": "M5"})
    return replace(small, **changes)


def recorded(path: Path, events: Iterable[Event], **changes: Any) -> Path:
    with Recorder(settings(path, **changes)) as recorder:
        for event in events:
            recorder.log(event)
    return path


_LOGS = """
import pickle, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
settings, events = pickle.loads(Path(sys.argv[2]).read_bytes())
{opens}
for event in events:
    sink.log(event)
    print(event.frame_index, flush=True)
    time.sleep(0.002)
time.sleep(60)
"""


def killed(opens: str, settings: RecorderSettings, events: Sequence[Event], *, feed: Path, at: int) -> int:
    """A process that logs the events into the ``sink`` that it ``opens`` is killed at a frame; its last one."""
    feed.write_bytes(pickle.dumps((settings, events)))
    words = [sys.executable, "-c", _LOGS.format(opens=opens), str(Path(__file__).parents[1]), str(feed)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        last = next((int(line) for line in process.stdout if int(line) >= at), -1)
        process.kill()
    assert last >= at, "it ended before"
    return last


def damaged(data: bytes, word: bytes, *, at: int = 0, by: bytes = b"\xff" * 40) -> bytes:
    """A file with other bytes in its first message that has the word."""
    # The header of each message is its kind and its length.
    end = begin = 12
    while word not in data[begin:end]:
        assert end < len(data), f"no message has {word!r}"
        begin, end = end + 16, end + 16 + int.from_bytes(data[end + 8 : end + 16], "little")
    return data[: begin + at] + by + data[begin + at + len(by) :]


def ends_its_reader(data: bytes) -> bytes:
    """A file with one other byte, on which the SDK does not raise: it ends its process."""
    return damaged(data, b"Boxes2D:half_sizes", at=68, by=b"\0")


class Recording:
    """All rows of an .rrd file, by entity and component."""

    def __init__(self, path: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the SDK warns that there is no footer, which is on purpose
            self.reader = RrdReader(path)
            self.chunks: list[Chunk] = list(self.reader.stream())
            self.blueprints = len(self.reader.blueprints())
        self.timelines = {name for chunk in self.chunks for name in chunk.timeline_names}
        self._rows: dict[tuple[str, str], list[tuple[int, int, Any]]] = {}
        for chunk in self.chunks:
            for component, frame, capture_ns, value in _rows(chunk):
                self._rows.setdefault((chunk.entity_path, component), []).append((frame, capture_ns, value))
        for rows in self._rows.values():
            rows.sort(key=lambda row: row[0])

    def rows(self, entity: str, component: str) -> list[tuple[int, int, Any]]:
        """(frame, capture_ns, value) in order of frames; a static value has frame `STATIC`."""
        return self._rows.get((entity, component), [])

    def latest(self, entity: str, component: str, frame: int) -> Any:
        """What a viewer shows of a component at a frame: its latest row, or the static one; None before the first."""
        rows = self.rows(entity, component)
        at = bisect_right([row[0] for row in rows], frame)
        return rows[at - 1][2] if at else None

    def video(self) -> list[tuple[int, int, bytes]]:
        """(frame, capture_ns, access unit)."""
        return [(f, ns, bytes(v[0])) for f, ns, v in self.rows("/base/video", "VideoStream:sample")]

    def events(self) -> list[tuple[int, str, str]]:
        texts = self.rows("/events", "TextLog:text")
        levels = self.rows("/events", "TextLog:level")
        return [(f, level[0], text[0]) for (f, _, text), (_, _, level) in zip(texts, levels, strict=True)]

    def lines(self, entity: str) -> list[tuple[int, list[float]]]:
        """(frame, one value a line) of a plot, such as ``/link/bitrate``."""
        return [(f, list(v)) for f, _, v in self.rows(entity, "Scalars:scalars")]

    def stills(self) -> list[tuple[int, bytes]]:
        """(frame, picture) of every still, once, wherever it is: gallery, enhanced picture, or neither."""
        found = set(self._pictures("still"))
        for (entity, component), rows in self._rows.items():
            if component == "EncodedImage:blob" and entity.startswith("/base/patches/"):
                found |= {(frame, bytes(value[0])) for frame, _, value in rows if value}
        return sorted(found)

    def base_crops(self) -> list[tuple[int, bytes]]:
        return self._pictures("base")

    def boxes(self, frame: int) -> dict[int, ReadBox]:
        """Every track a viewer shows at a frame, by its id."""
        found: dict[int, ReadBox] = {}
        for layer in ("tracks", "reported", "refined", "doubted"):
            found |= self._layer(layer, frame)
        return found

    def words(self, frame: int) -> dict[int, tuple[str, tuple[float, float]]]:
        """What is written on the picture, and the point that it is centred below, by track."""
        texts = self.latest("/base/labels", "Points2D:labels", frame) or []
        places = self.latest("/base/labels", "Points2D:positions", frame) or []
        return {
            int(text.split()[0]): (text, (place[0], place[1]))
            for text, place in zip(texts, places, strict=True)
        }

    def patches(self, frame: int) -> dict[int, tuple[float, float, float, bytes]]:
        """The stills on the enhanced picture at a frame: x, y, scale and JPEG, by slot."""
        found = {}
        for slot in range(100):
            entity = f"/base/patches/{slot}"
            blob = self.latest(entity, "EncodedImage:blob", frame)
            if blob:
                x, y, _ = self.latest(entity, "Transform3D:translation", frame)[0]
                scale = self.latest(entity, "Transform3D:scale", frame)[0][0]
                found[slot] = (x, y, scale, bytes(blob[0]))
        return found

    def _layer(self, layer: str, frame: int) -> dict[int, ReadBox]:
        entity, reported = f"/base/{layer}", layer == "reported"
        refined, words = layer in ("refined", "doubted"), self.words(frame)
        shape = "Ellipses2D" if reported else "Boxes2D"
        ids = self.latest(entity, "track_id", frame) or []
        centres = self.latest(entity, f"{shape}:centers", frame) or []
        halves = self.latest(entity, f"{shape}:half_sizes", frame) or []
        before = self.latest(entity, "class_before", frame) or []
        after = self.latest(entity, "class_now", frame) or []
        shown = self.latest(entity, f"{shape}:class_ids", frame) or []
        confidences = self.latest(entity, "confidence_pct", frame) or []
        origins = self.latest(entity, "origin", frame) or [None] * len(ids)
        names = self._class_names(entity)
        rows = zip(ids, centres, halves, before, after, shown, confidences, origins, strict=True)
        return {
            track: ReadBox(
                box_px=(c[0] - h[0], c[1] - h[1], c[0] + h[0], c[1] + h[1]),
                class_before=names[b],
                class_after=names[a],
                confidence_pct=p,
                refined=refined,
                reported=reported,
                origin=origin,
                label=words.get(track, ("",))[0],
                doubted=layer == "doubted",
                word=names[w],
            )
            for track, c, h, b, a, w, p, origin in rows
        }

    def _class_names(self, entity: str) -> dict[int, str]:
        rows = self.rows(entity, "AnnotationContext:context")
        return (
            {i["class_id"]: i["class_description"]["info"]["label"] for i in rows[-1][2][0]} if rows else {}
        )

    def _pictures(self, name: str) -> list[tuple[int, bytes]]:
        found = []
        for (entity, component), rows in self._rows.items():
            hidden = entity == "/stills/more" and name == "still"
            if component == "EncodedImage:blob" and (entity.endswith(f"/{name}") or hidden):
                found += [(frame, bytes(value[0])) for frame, _, value in rows]
        return sorted(found)


def _rows(chunk: Chunk) -> Iterator[tuple[str, int, int, Any]]:
    batch = chunk.to_record_batch()
    frames = [STATIC] * chunk.num_rows
    captures = [STATIC] * chunk.num_rows
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        if name == "frame":
            frames = column.to_pylist()
        elif name == "capture_time":
            captures = column.cast("int64").to_pylist()
    for field, column in zip(batch.schema, batch.columns, strict=True):
        component = (field.metadata or {}).get(b"rerun:component", b"").decode()
        if component:
            for frame, capture_ns, value in zip(frames, captures, column.to_pylist(), strict=True):
                if value is not None:
                    yield component, frame, capture_ns, value
