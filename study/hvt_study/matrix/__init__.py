"""The matrix of the study: every method at every budget on every sequence, at matched totals, one row a run."""
