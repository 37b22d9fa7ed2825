"""What gives way when far more comes than can be looked at, and that it is told of once."""

from dataclasses import replace

from hvt_common.transport.inbox import FloodWatch, Inbox, Received, TokenBucket

SECOND_NS = 1_000_000_000
ITEM = Received("hvt/uav-1/base", b"x" * 100, b"", "", 0)


def test_a_flood_is_told_of_once_a_minute_and_never_where_there_is_none():
    """Nobody would look for who sends it; or the log would be full of it."""
    watch = FloodWatch(most_per_s=100)
    for second in range(5):
        for _ in range(100):
            assert watch.note("base", now_ns=second * SECOND_NS) is None
            assert watch.note("status", now_ns=second * SECOND_NS) is None
    told = [watch.note("base", now_ns=n * SECOND_NS // 500) for n in range(10 * 500, 130 * 500)]
    assert [n for n in told if n is not None] == [101, 101]
    first, second = (index for index, n in enumerate(told) if n is not None)
    assert second - first >= 60 * 500


def test_of_a_flood_some_comes_through():
    """All or nothing of it would be said; and after a step of the clock nothing any more."""
    bucket = TokenBucket(burst=3, every_ns=SECOND_NS)
    granted = [bucket.take(n * SECOND_NS // 4) for n in range(20)]
    assert granted == [True] * 3 + [n % 4 == 0 for n in range(3, 20)]
    assert [bucket.take(100 * SECOND_NS) for _ in range(4)] == [True] * 3 + [False]
    assert [bucket.take(SECOND_NS), bucket.take(2 * SECOND_NS)] == [False, True], "the clock was set back"


def test_one_row_does_not_keep_the_others_out_of_the_inbox():
    """A flood of status would leave no room for video, in messages or in bytes."""
    inbox = Inbox(capacity=8, share=0.75)

    def put(count, **other):
        for _ in range(count):
            inbox.put(replace(ITEM, **other))
        return len(inbox), inbox.dropped

    assert put(50, key="hvt/uav-1/status") == (6, 44)
    assert put(3) == (8, 45)
    assert inbox.get(timeout_s=0).key == "hvt/uav-1/status"
    put(1)
    assert [inbox.get(timeout_s=0).key.rpartition("/")[2] for _ in range(8)] == ["status"] * 5 + ["base"] * 3
    assert put(6)[0] == 6, "what was taken out makes room again"
    inbox = Inbox(capacity=100, capacity_bytes=1000, share=0.5)
    put(9)
    assert put(1, key="hvt/uav-1/roi") == (6, 4)
