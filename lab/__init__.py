"""Programs that try HVT hard: bad links (`link`), failing parts (`failures`), fuzzers of foreign input (`fuzz`)."""
