"""One run from its specification to its row: methods, settings, materials, matched totals, scores."""
