"""Which runs a study takes, and where they are done: `StudyPlan`, `run_all`, `compare`."""
