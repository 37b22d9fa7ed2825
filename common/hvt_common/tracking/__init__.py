"""ByteTrack: others use `bytetrack`, and `association` of boxes; Kalman filter and table are its parts.

`recall` weighs an object that only one of two detectors finds.
"""
