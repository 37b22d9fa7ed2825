"""One frame after the other: in real time, or in lockstep with media time."""
