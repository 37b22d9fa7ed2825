"""One run from its specification to its row: `RunSpec`, `METHODS`, `run_spec`, `COLUMNS`."""
