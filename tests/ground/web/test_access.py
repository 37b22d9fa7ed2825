"""Who may open the page: tokens that several grounds of one machine share."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

from hvt_ground.web.access import own_tokens

GROUNDS = 8


def test_grounds_that_start_at_once_agree_on_their_tokens(tmp_path):
    """All but one would end with a sentence that nobody understands, or know tokens that no link has."""
    together = Barrier(GROUNDS)

    def start(folder):
        together.wait()
        return own_tokens(folder)

    with ThreadPoolExecutor(GROUNDS) as pool:
        for number in range(20):
            folder = tmp_path / str(number)
            found = list(pool.map(start, [folder] * GROUNDS))
            assert all(one == found[0] for one in found)
            assert [one.name for one in folder.iterdir()] == ["web-tokens.json"]
            assert (folder / "web-tokens.json").stat().st_mode & 0o777 == 0o600
