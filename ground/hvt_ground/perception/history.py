"""The pictures and tracks of the last seconds, by frame index.

A still arrives after its frame: it is matched to the tracks of that very frame and shown beside (or pasted
into) the decoded picture of it. Tracks are small and kept for `track_frames`. Pictures are large: 1280x720 BGR
is 2.7 MB, so they are kept as they were decoded, in half of it. Where the edge codes fewer frames than there are
frames, as many reach back further, up to a bound. There is no lossy detour, because a residual still must be applied
to exactly the pixels that the edge had.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from hvt_common.values import Image, Tracks
from hvt_common.video.hevc import Picture, YuvPicture

DEFAULT_MAX_BYTES = 96 * 1024 * 1024


@dataclass(eq=False)
class History:
    """Two bounded rings of one session, of pictures and of tracks; both grow by rising frame index only.

    The newest picture is stored whatever ``max_bytes``, and none of more than ``reach_frames`` before it.
    ``track_frames`` covers at least the time that a still may be late; over ``gap_frames`` that the base stream
    leaves out, tracks are still interpolated.
    """

    _: KW_ONLY
    max_frames: int = 45
    max_bytes: int = DEFAULT_MAX_BYTES
    reach_frames: int = 300
    track_frames: int = 300
    gap_frames: int = 0

    def __post_init__(self) -> None:
        self._frames: dict[int, Picture] = {}
        self._tracks: dict[int, Tracks] = {}
        self.size_bytes = 0
        """Bytes of the pictures held; any thread may read it."""

    @property
    def oldest_tracked(self) -> int | None:
        """Frame index of the oldest tracks held; None before the first."""
        return next(iter(self._tracks), None)

    @property
    def newest_tracked(self) -> int | None:
        """Frame index of the newest tracks held; None before the first."""
        return next(reversed(self._tracks), None)

    def add_frame(self, frame_index: int, picture: Picture) -> None:
        """Keep a decoded picture (not copied: nobody may write to it again); `ValueError` unless frames rise."""
        newest = next(reversed(self._frames), -1)
        if frame_index <= newest:
            raise ValueError(
                f"frame {frame_index} after frame {newest}: frames rise; clear() begins a session"
            )
        self._frames[frame_index] = picture
        self.size_bytes += picture.nbytes
        while (oldest := next(iter(self._frames))) < frame_index and (
            len(self._frames) > self.max_frames
            or self.size_bytes > self.max_bytes
            or oldest < frame_index - self.reach_frames
        ):
            self.size_bytes -= self._frames.pop(oldest).nbytes

    def add_tracks(self, tracks: Tracks) -> None:
        """Keep the tracks of a frame, in place of those that it has; frames before all that are held stay out.

        An empty `Tracks` says that the frame was analyzed and held nothing.
        """
        index = tracks.frame_index
        if index < (self.oldest_tracked or 0):
            return
        late = index < (self.newest_tracked or 0) and index not in self._tracks
        self._tracks[index] = tracks
        if late:
            self._tracks = dict(sorted(self._tracks.items()))
        if len(self._tracks) > self.track_frames:
            del self._tracks[next(iter(self._tracks))]

    def picture(self, frame_index: int) -> Picture | None:
        """The picture of that frame as it was given; None if it was never decoded or is gone."""
        return self._frames.get(frame_index)

    def frame(self, frame_index: int) -> Image | None:
        picture = self._frames.get(frame_index)
        return None if picture is None else as_bgr(picture)

    def frame_before(self, frame_index: int, *, within: int) -> Image | None:
        """The picture of that frame or, where it was left out, of the newest one up to ``within`` frames before."""
        before = [index for index in self._frames if frame_index - within <= index <= frame_index]
        return self.frame(max(before)) if before else None

    def tracks(self, frame_index: int) -> Tracks | None:
        """The tracks at that frame; None if it was lost, is not tracked yet, or is gone.

        Of a frame that the base stream left out: those that are there before and after, on a straight line.
        """
        exact = self._tracks.get(frame_index)
        if exact is not None:
            return exact
        before = next((one for one in reversed(self._tracks) if one < frame_index), None)
        after = next((one for one in self._tracks if one > frame_index), None)
        if before is None or after is None or after - before > self.gap_frames:
            return None
        share = (frame_index - before) / (after - before)
        return _between(self._tracks[before], self._tracks[after], frame_index, share=share)

    def rename_track(self, survivor_id: int, merged_id: int) -> None:
        """Two tracks have turned out to be one: where only the second is listed it gets the id of the first."""
        for index, tracks in self._tracks.items():
            if merged_id in tracks.ids and survivor_id not in tracks.ids:
                ids = np.where(tracks.ids == merged_id, survivor_id, tracks.ids)
                self._tracks[index] = replace(tracks, ids=ids)

    def clear(self) -> None:
        """Forget everything: a new session counts its frames from 0 again."""
        self._frames.clear()
        self._tracks.clear()
        self.size_bytes = 0


def as_bgr(picture: Picture) -> Image:
    return picture.bgr() if isinstance(picture, YuvPicture) else picture


def _between(before: Tracks, after: Tracks, frame_index: int, *, share: float) -> Tracks:
    _, old, new = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    boxes = (1 - share) * before.boxes_xyxy_px[old] + share * after.boxes_xyxy_px[new]
    return Tracks(
        frame_index=frame_index,
        ids=before.ids[old],
        boxes_xyxy_px=boxes.astype(np.float32),
        confidences=before.confidences[old],
        class_ids=before.class_ids[old],
        born_frames=before.born_frames[old],
        seen_frames=before.seen_frames[old],
        started=np.zeros(len(old), np.bool_),
    )
