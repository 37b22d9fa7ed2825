"""The base stream: `frame_decision` and `stage` a frame, `x265`, `reconfigure` its rates, `regions` its ROIs."""
