"""What every caption has to say: of how many sequences, which labels, which networks, under which conditions."""

from __future__ import annotations

from hvt_study.metrics.bits import Accounting
from hvt_study.report.data.arms import Setting, place
from hvt_study.report.data.intervals import ENOUGH

INTERVALS = f"95 % bootstrap interval over sequences (from {ENOUGH} on)"
"""How means are bracketed."""
_LABELS = {
    "annotations": "annotations (people's, or exact)",
    "reference": "reference (the detector on source frames before they are coded, in tiles, "
    "none smaller than the base)",
}
_NAMED = 4
"""Of several datasets; the rest is counted."""


def under(setting: Setting) -> str:
    """The end of a caption."""
    n = setting.sequences
    parts = [f"{n} sequence{'' if n == 1 else 's'}{_datasets(setting)}"]
    parts += [f"labels: {_LABELS.get(setting.labels, setting.labels)}", str(setting.models)]
    parts += setting.conditions.unusual()
    parts += [f"{method} with {' '.join(tune)}" for method, tune in setting.tunes.items()]
    if setting.accounting == "pilot":
        parts.append("rates by the length of the whole clip, as the pilot's")
    return f"{'; '.join(parts)}."


def same_sequences(setting: Setting) -> str:
    """A sentence for tables of means of which not all are of all sequences; empty where they are."""
    arms = [arm for regime in setting.regimes for arm in setting.arms(regime)]
    if all(len(setting.runs(arm)) == setting.sequences for arm in arms):
        return ""
    return "Means of fewer sequences (n) are not to be compared with the others. "


def time_of(accounting: Accounting | str) -> str:
    """What bytes are divided by."""
    return "length of the whole clip" if accounting == "pilot" else "processed span"


def _datasets(setting: Setting) -> str:
    names = [place(one) for one in setting.datasets]
    if len(names) == 1:
        return ""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f" of {', '.join(names[:_NAMED])}{more}"
