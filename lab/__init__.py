"""Programs that try HVT hard: a laboratory of bad links (`link`) and fuzzers of all foreign input (`fuzz`)."""
