"""Texts for the reasons and outcomes of stills; `Status`, JSON and metrics have the words of the code."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

STILL_WORDS: Mapping[str, str] = MappingProxyType(
    {
        # Why the edge sent it.
        "gain": "would show more than the video",
        "due": "had waited longest",
        "new": "of new tracks",
        "uncertain": "of uncertain class",
        "small": "of small objects",
        "utility": "of most use within the budget",
        "asked": "on demand",
        "again": "sent again",
        "stored": "stored for later",
        # Why it did not.
        "base_good": "the video already shows well",
        "border": "cut by the picture's edge",
        "cooldown": "sent a moment ago",
        "no_gain": "look as they did in their last still",
        "refused": "refused a moment ago",
        "replaced": "replaced by a newer view",
        "queue_full": "no room in the budget",
        "too_large": "too large for the budget",
        "stale": "waited too long for room in the budget",
        "ended": "came too late: the flight ended",
        # What the ground made of it.
        "matched": "named a track",
        "superseded": "older than what named the track",
        "no track": "matched no track",
        "ambiguous": "could be of several tracks",
        "frame lost": "of a frame that was lost",
        "late": "too late for their frame",
        "unread": "not recognised",
        "overflow": "too many at once",
        "undecodable": "damaged",
        "base_missing": "of a frame that the ground does not have",
        # More kinds than are counted by name.
        "other": "for other reasons",
    }
)
"""Word of the code → the text behind a number of stills."""


def still_words(reason: str) -> str:
    """For people; a word of a later version is said as it is."""
    return STILL_WORDS.get(reason, reason.replace("_", " "))


def counts_text(counts: Mapping[str, int], *, most: int | None = None) -> str:
    """``49 the video already shows well, 3 cut by the picture's edge``: the most frequent first, ``most`` of them."""
    ordered = sorted(counts.items(), key=lambda one: (-one[1], one[0]))
    return ", ".join(f"{count} {still_words(name)}" for name, count in ordered[:most])
