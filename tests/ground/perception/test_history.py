"""The last seconds of pictures and tracks: found by frame, bounded, and never mixed up."""

from __future__ import annotations

import numpy as np
import pytest

from hvt_common.values import Tracks
from hvt_ground.perception.history import History
from rigs.flight import tracks_at


def picture(value, *, height=4, width=6):
    """A picture of one value."""
    return np.full((height, width, 3), value, np.uint8)


def test_a_frame_is_found_by_its_index_just_as_it_was():
    """A still would be shown beside, or pasted into, the picture of another moment."""
    history = History(max_frames=3)
    for index in (2, 5, 6):
        history.add_frame(index, picture(index))
    assert [int(history.frame(index)[0, 0, 0]) for index in (2, 5, 6)] == [2, 5, 6]
    assert history.frame(3) is None
    history.add_frame(9, picture(9))
    assert history.frame(2) is None
    assert history.frame(5) is not None


def test_pictures_stay_within_their_bytes():
    """A ground that runs for hours would run out of memory."""
    one = picture(0).nbytes
    history = History(max_frames=100, max_bytes=3 * one)
    for index in range(50):
        history.add_frame(index, picture(index))
        assert history.size_bytes <= 3 * one
    assert [index for index in range(50) if history.frame(index) is not None] == [47, 48, 49]
    history.add_frame(50, picture(50, height=40))
    assert history.frame(50) is not None, "the newest is kept even if it is too large by itself"
    assert history.frame(49) is None
    assert history.size_bytes == picture(50, height=40).nbytes


def test_pictures_of_a_thin_stream_do_not_reach_back_for_ever():
    """Half of the frames coded, and a ground held six seconds of each edge, for stills that nobody sends any more."""
    history = History(max_frames=45, reach_frames=60)
    for index in range(0, 200, 2):
        history.add_frame(index, picture(index))
    assert [index for index in range(200) if history.frame(index) is not None] == list(range(138, 200, 2))


def test_the_default_holds_two_seconds_of_720p():
    """Stills that wait two seconds on a thin link would have no picture to be compared with."""
    history = History()
    image = np.zeros((720, 1280, 3), np.uint8)
    for index in range(60):
        history.add_frame(index, image)
    assert history.frame(30) is not None
    assert history.size_bytes <= 96 * 1024 * 1024


def test_tracks_are_found_by_frame_and_bounded():
    """A still would be matched to the tracks of another frame: the wrong object is refined."""
    history = History(track_frames=4)
    assert history.oldest_tracked is None
    assert history.newest_tracked is None
    for index in (0, 1, 3, 4, 8):
        history.add_tracks(Tracks.none(index))
    assert (history.oldest_tracked, history.newest_tracked) == (1, 8)
    assert history.tracks(3).frame_index == 3
    assert history.tracks(0) is None
    assert history.tracks(2) is None


def listed(frame_index, boxes):
    """Tracks from ``{id: left edge}``."""
    return tracks_at(frame_index, {i: (left, 0.0, left + 10, 10.0) for i, left in boxes.items()})


def test_what_is_learned_later_is_put_where_it_belongs():
    """A still of a track that the edge reported late would match nothing at its frame."""
    history = History(track_frames=4)
    for index in (0, 2, 4):
        history.revise_tracks(listed(index, {1: 0.0}))
    history.revise_tracks(listed(2, {1: 5.0, 2: 50.0}))
    history.revise_tracks(listed(3, {1: 7.0}))
    assert history.tracks(2).ids.tolist() == [1, 2]
    assert history.newest_tracked == 4
    history.revise_tracks(listed(1, {1: 3.0}))
    assert history.oldest_tracked == 1, "no more than four"
    history.revise_tracks(listed(0, {1: 3.0}))
    assert history.tracks(0) is None, "what is gone does not come back"
    history.rename_track(1, 2)
    assert history.tracks(2).ids.tolist() == [1, 2]
    assert history.tracks(3).ids.tolist() == [1]
    history.rename_track(9, 1)
    assert history.tracks(3).ids.tolist() == [9]


def test_between_two_frames_tracks_lie_on_a_line():
    """Where the base leaves frames out, stills of them would refine nothing; or something far away."""
    history = History(gap_frames=15)
    history.add_tracks(listed(0, {1: 0.0, 2: 90.0}))
    history.add_tracks(listed(4, {1: 8.0, 3: 50.0}))
    history.add_tracks(listed(24, {1: 8.0}))
    assert history.tracks(3).ids.tolist() == [1]
    np.testing.assert_allclose(history.tracks(3).boxes_xyxy_px, [[6, 0, 16, 10]])
    assert history.tracks(12) is None, "twenty frames are no gap but an outage"
    assert history.tracks(25) is None
    assert (history.oldest_tracked, history.newest_tracked) == (0, 24)


def test_a_frame_without_a_picture_has_the_one_before_it():
    """Re-detection would have no surroundings for a still of such a frame."""
    history = History()
    history.add_frame(4, picture(4))
    history.add_frame(9, picture(9))
    assert int(history.frame_before(8, within=5)[0, 0, 0]) == 4
    assert int(history.frame_before(9, within=5)[0, 0, 0]) == 9
    assert history.frame_before(3, within=5) is None
    assert history.frame_before(15, within=5) is None


def test_a_new_session_begins_with_clear():
    """Frames of two flights would be mixed under one index."""
    history = History()
    history.add_frame(7, picture(7))
    history.add_tracks(Tracks.none(7))
    with pytest.raises(ValueError, match="frame 7 after frame 7"):
        history.add_frame(7, picture(0))
    with pytest.raises(ValueError, match="frame 0 after frame 7"):
        history.add_tracks(Tracks.none(0))
    history.clear()
    assert history.size_bytes == 0
    assert history.frame(7) is None
    history.add_frame(0, picture(0))
    history.add_tracks(Tracks.none(0))
    assert history.newest_tracked == 0
