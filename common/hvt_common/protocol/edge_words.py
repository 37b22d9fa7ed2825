"""Texts for the words of an edge: reasons and outcomes of stills and frames, failed parts, decisions of auto.

`Status`, JSON and metrics have the words of the code.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, Self, get_args

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
        "queue_full": "less useful than others waiting",
        "too_large": "too large for the budget",
        "stale": "waited too long",
        "ended": "came too late: the flight ended",
        # The outcome at the ground.
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


PART_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "source": "the camera",
        "pose": "the source of poses",
        "encoder": "the encoder",
        "video": "video at its full size",
        "passthrough": "the camera's video as it comes",
        "local copy": "the copy on the edge's disk",
        "detector": "the detector",
        "detector 1": "the first network of the detector",
        "detector 2": "the second network of the detector",
        "detector 3": "the third network of the detector",
        "stills": "the choice of stills",
        "requested stills": "making closer looks",
        "reports": "taking reports of grounds",
        "pictures": "pictures on their way to a ground",
        "store": "the store for outages",
        "backlog": "sending what was stored",
        "info": "telling grounds of the flight",
        "control": "taking commands",
        "listener": "waiting for grounds",
        "metrics": "the port for metrics",
        "flight": "the flight, which broke off",
    }
)
"""Part of an edge that may fail → its name for people."""


def part_words(part: str) -> str:
    """For people; a part of a later version is called as it is."""
    return PART_WORDS.get(part, part)


DECISION_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "tracks": "The edge sends its tracks",
        "no tracks": "The edge sends no tracks",
        "stills": "Stills are sent",
        "stills show details": "Stills are sent for their details",
        "stills paused": "Stills are paused",
        "video alone": "Video alone is sent",
    }
)
"""Decision of ``--profile auto`` → how a sentence on it begins."""


def each_decision(says: str) -> list[tuple[str, str]]:
    """Each decision of `Status.decisions`, and why: ``tracks: A; stills paused: B``."""
    parts = [re.split("[:,] ", part, maxsplit=1) for part in says.split("; ") if part]
    return [(part[0], part[1] if len(part) > 1 else "") for part in parts]


def decision_sentences(says: str) -> list[str]:
    """The same as sentences for people; a decision of a later version is shown by its own word."""
    sentences = []
    for decision, why in each_decision(says):
        begins = DECISION_WORDS.get(decision, f"{decision[:1].upper()}{decision[1:]}")
        sentence = f"{begins}: {why}." if why else f"{begins}."
        if why == "no answer yet":  # none may have been sent
            sentence = f"{begins.replace('are sent', 'may be sent')}: the ground has judged none yet."
        sentences.append(sentence)
    return sentences


FrameGroup = Literal[
    "sent",
    "nobody_listened",
    "stored",
    "frame_rate",
    "budget",
    "link",
    "processor",
    "closer_look",
    "unreadable",
    "encoder",
]
"""Their order is that of the counts on the wire: a new one stands last."""

FRAME_GROUPS: Mapping[FrameGroup, str] = MappingProxyType(
    {
        "sent": "sent",
        "nobody_listened": "coded while nobody listened",
        "stored": "stored for later",
        "frame_rate": "left out by {frame_rate}",
        "budget": "had no room in the budget",
        "link": "the link did not carry",
        "processor": "the processor had no time for",
        "closer_look": "left out for a closer look",
        "unreadable": "damaged at the source",
        "encoder": "the encoder failed on",
    }
)
"""Group → the text behind its number."""

assert tuple(FRAME_GROUPS) == get_args(FrameGroup), "one order"


@dataclass(frozen=True, slots=True)
class FrameAccount:
    """Number of source frames in each group, each in exactly one. Groups without a frame may be missing.

    The edge counts (`hvt_edge.loop.counts`), `Status` carries the counts, and status line, summary, page and JSON of
    both sides show this value, so that their numbers add up to the frames that came.
    """

    groups: Mapping[FrameGroup, int] = field(default_factory=dict)
    coded_fps: float = 0.0
    """Frames a second that the frame rate leaves now; 0 where that is not known."""
    auto_fps: bool = False
    """``--fps auto`` chose it."""

    @property
    def came(self) -> int:
        """All frames that the source gave."""
        return sum(self.groups.values())

    @property
    def dropped(self) -> int:
        """Given up before encoding, for any reason but the frame rate and the source's own damage."""
        return sum(
            self.groups.get(name, 0) for name in ("budget", "link", "processor", "closer_look", "encoder")
        )

    def __str__(self) -> str:
        """Such as ``220 frames came: 71 sent, 50 left out by auto's 7.5 a second, 81 had no room in the budget``."""
        frames = "1 frame" if self.came == 1 else f"{self.came} frames"
        said = [
            f"{self.groups[name]} {text.format(frame_rate=self._frame_rate)}"
            for name, text in FRAME_GROUPS.items()
            if self.groups.get(name)
        ]
        return f"{frames} came: {', '.join(said)}" if said else "no frame came"

    @property
    def _frame_rate(self) -> str:
        if not self.coded_fps:
            return "the frame rate"
        whose = "auto's" if self.auto_fps else "the frame rate of"
        return f"{whose} {self.coded_fps:.3g} a second"

    def as_counts(self) -> tuple[int, ...]:
        """For the wire: the groups' counts in their order, without zeros at the end."""
        counts = [self.groups.get(name, 0) for name in FRAME_GROUPS]
        while counts and not counts[-1]:
            counts.pop()
        return tuple(counts)

    @classmethod
    def of_counts(cls, counts: Sequence[int], *, coded_fps: float, auto_fps: bool) -> Self:
        """Read the result of `as_counts`; further groups of a later version are ignored."""
        groups = {name: count for name, count in zip(FRAME_GROUPS, counts, strict=False) if count}
        return cls(groups, coded_fps, auto_fps)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: ``came``, each group by name, zeros included, and the sentence as ``text``."""
        return {
            "came": self.came,
            **{name: self.groups.get(name, 0) for name in FRAME_GROUPS},
            "text": str(self),
        }
