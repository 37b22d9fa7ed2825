"""ByteTrack: others use `bytetrack`, its `settings`, and `association` of boxes; the rest are its parts.

`recall` weighs an object that only one of two detectors finds.
"""
