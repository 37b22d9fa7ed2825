"""Poses of an edge's camera: fixed (`opening`), from `files` beside the clip, from an autopilot by `mavlink`."""
