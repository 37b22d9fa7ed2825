"""ByteTrack: others use `bytetrack`, and `association` of boxes; Kalman filter and table are its parts."""
