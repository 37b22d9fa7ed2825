"""Programs that try HVT hard: bad links (`link`), failing parts (`failures`), fuzzers of foreign input (`fuzz`)."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))  # the parts of tests serve here too
