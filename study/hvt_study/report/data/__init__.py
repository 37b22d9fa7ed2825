"""Values that tables and figures share: rows by arm and sequence, pairs, intervals, names of metrics."""
