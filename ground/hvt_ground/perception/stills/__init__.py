"""A still at the ground: decoded, classified, matched to its track, and what it changes there."""
