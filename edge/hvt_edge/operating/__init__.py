"""What changes in flight: rates, method and keyframe requests, read by everybody and written by their owners."""
