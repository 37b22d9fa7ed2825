"""Poses of the camera for an edge: `fixed`, from `files` beside the clip, from an autopilot by `mavlink`."""
