"""One frame after the other: `realtime`, or `lockstep` with media time; `counts` of frames, `cpu` they would take."""
