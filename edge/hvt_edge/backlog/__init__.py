"""Store-and-forward: objects captured while the link is away are stored, and sent when it is back.

For others: `stage` (`BacklogStage`: LIVE, OFFLINE, RETURNING) and `disk` (`Store`). Inside: `worker` is the thread of
the disk with its queue, `backfill` cuts stored objects into chunks, `entry` is one stored object.
"""
