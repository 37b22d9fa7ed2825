"""ByteTrack: others use `bytetrack`, and `association` of boxes; Kalman filter and table are its parts.

`alone` says what to think of an object that only one of two observers sees.
"""
