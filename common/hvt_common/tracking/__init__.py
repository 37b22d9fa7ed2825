"""ByteTrack: Kalman filter, association, camera motion."""
