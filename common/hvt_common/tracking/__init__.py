"""ByteTrack: others use `bytetrack`; Kalman filter, association and table are its parts."""
