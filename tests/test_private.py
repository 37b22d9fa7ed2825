"""No test sets a private name of the product: what a test has to set is a parameter. SLF001 sees to the rest."""

import re
from pathlib import Path

TESTS = Path(__file__).parent
_SET = re.compile(r"""setattr\(\s*(?:["'][\w.]+\._\w+["']|[\w.]+,\s*["']_\w+["'])""")


def test_no_private_name_is_set():
    """A test would hold the inside of a module still, and fail when somebody improves it."""
    found = [
        f"{path.relative_to(TESTS)}:{text.count(chr(10), 0, match.start()) + 1}"
        for path in sorted(TESTS.rglob("*.py"))
        for text in [path.read_text(encoding="utf-8")]
        for match in _SET.finditer(text)
    ]
    assert found == []
