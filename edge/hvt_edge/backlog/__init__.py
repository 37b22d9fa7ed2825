"""Store-and-forward: what is seen while the link is away is stored, and sent when it is back.

For others: `stage` (`BacklogStage`: LIVE, OFFLINE, RETURNING) and `disk` (`Store`). Inside: `worker` is the thread of
the disk with its queue, `backfill` makes chunks of what is stored, `entry` is one stored object.
"""
