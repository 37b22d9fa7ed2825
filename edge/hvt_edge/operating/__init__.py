"""Settings that change in flight, with one owner each: `point` (rates, method), `keyframes`, `levers`.

`levers` are the decisions of ``--profile auto``: tracks and stills while they pay. Keyframes may be requested from
any thread.
"""
