"""What changes in flight, with one owner each: `point` (rates, method, levers), `keyframes` (requests), `levers`.

`levers` decides what is sent beside the video; keyframes may be requested from any thread.
"""
