"""The last seconds of pictures and tracks: found by frame, bounded, and never mixed up."""

import threading

import numpy as np
import pytest

from hvt_common.values import Tracks
from hvt_ground.perception.history import DEFAULT_MAX_BYTES, History
from rigs.flight import tracks_at


def picture(value, *, height=4, width=6):
    return np.full((height, width, 3), value, np.uint8)


ONE = picture(0).nbytes


@pytest.mark.parametrize(
    ("bounds", "given", "kept"),
    [
        ({"max_frames": 3}, [(2, 4), (5, 4), (6, 4), (9, 4)], [5, 6, 9]),
        ({"max_frames": 100, "max_bytes": 3 * ONE}, [(index, 4) for index in range(50)], [47, 48, 49]),
        # The newest is kept though it is too large by itself.
        ({"max_bytes": 3 * ONE}, [(48, 4), (49, 4), (50, 40)], [50]),
        # Of a thin stream no pictures reach back for ever, for stills that nobody sends any more.
        ({"reach_frames": 60}, [(index, 4) for index in range(0, 200, 2)], list(range(138, 200, 2))),
        # Two seconds of 720p: stills on a thin link wait so long.
        ({}, [(index, 150_000) for index in range(60)], list(range(23, 60))),
    ],
)
def test_pictures_are_found_as_they_were_and_bounded(bounds, given, kept):
    """A still would be shown in the picture of another moment, or a ground that runs for hours out of memory."""
    history = History(**bounds)
    for index, height in given:
        history.add_frame(index, picture(index, height=height))
        assert history.size_bytes <= max(bounds.get("max_bytes", DEFAULT_MAX_BYTES), height * ONE // 4)
    found = {index: history.frame(index) for index in range(given[-1][0] + 1)}
    assert {index: one[0, 0, 0] for index, one in found.items() if one is not None} == {k: k for k in kept}


def test_their_size_is_read_while_they_come():
    """A report of another thread ended the session with a RuntimeError."""
    history, errors, ended = History(), [], threading.Event()

    def read() -> None:
        while not (errors or ended.is_set()):
            try:
                assert history.size_bytes >= 0
            except RuntimeError as error:
                errors.append(error)

    (reader := threading.Thread(target=read)).start()
    for index in range(20_000):
        history.add_frame(index, picture(0))
    ended.set()
    reader.join()
    assert not errors


def listed(frame_index, boxes):
    """Tracks from ``{id: left edge}``."""
    return tracks_at(frame_index, {i: (left, 0.0, left + 10, 10.0) for i, left in boxes.items()})


def test_tracks_are_found_by_frame_and_bounded():
    """A still would be matched to the tracks of another frame: the wrong object is refined."""
    history = History(track_frames=4)
    assert (history.oldest_tracked, history.newest_tracked) == (None, None)
    for index in (0, 1, 3, 4, 8):
        history.add_tracks(Tracks.none(index))
    assert (history.oldest_tracked, history.newest_tracked) == (1, 8)
    assert [history.tracks(index) is not None for index in (0, 2, 3)] == [False, False, True]


def test_what_is_learned_later_is_put_where_it_belongs():
    """A still of a track that the edge reported late would match nothing at its frame."""
    history = History(track_frames=4)
    for index, boxes in ((0, {1: 0.0}), (2, {1: 0.0}), (4, {1: 0.0}), (2, {1: 5.0, 2: 50.0}), (3, {1: 7.0})):
        history.add_tracks(listed(index, boxes))
    assert (history.tracks(2).ids.tolist(), history.newest_tracked) == ([1, 2], 4)
    history.add_tracks(listed(1, {1: 3.0}))
    assert history.oldest_tracked == 1, "no more than four"
    history.add_tracks(listed(0, {1: 3.0}))
    assert history.tracks(0) is None, "what is gone does not come back"
    for survivor, merged, ids in ((1, 2, [1, 2]), (9, 1, [2, 9])):
        history.rename_track(survivor, merged)
        assert sorted(history.tracks(2).ids.tolist()) == ids
    assert history.tracks(3).ids.tolist() == [9]


def test_between_two_frames_tracks_lie_on_a_line():
    """Where the base leaves frames out, stills of them would refine nothing; or something far away."""
    history = History(gap_frames=15)
    for index, boxes in ((0, {1: 0.0, 2: 90.0}), (4, {1: 8.0, 3: 50.0}), (24, {1: 8.0})):
        history.add_tracks(listed(index, boxes))
    assert history.tracks(3).ids.tolist() == [1]
    np.testing.assert_allclose(history.tracks(3).boxes_xyxy_px, [[6, 0, 16, 10]])
    assert history.tracks(12) is None, "twenty frames are no gap but an outage"
    assert history.tracks(25) is None
    assert (history.oldest_tracked, history.newest_tracked) == (0, 24)


def test_a_frame_without_a_picture_has_the_one_before_it_and_a_new_session_none():
    """Re-detection would have no surroundings for a still, or those of another flight under one index."""
    history = History()
    history.add_frame(4, picture(4))
    history.add_frame(9, picture(9))
    history.add_tracks(Tracks.none(9))
    found = [history.frame_before(index, within=5) for index in (8, 9, 3, 15)]
    assert [None if one is None else one[0, 0, 0] for one in found] == [4, 9, None, None]
    with pytest.raises(ValueError, match="frame 9 after frame 9"):
        history.add_frame(9, picture(0))
    history.clear()
    assert (history.size_bytes, history.frame(9), history.newest_tracked) == (0, None, None)
    history.add_frame(0, picture(0))
