"""Rows of a study's table as tests need them: short, and with figures that can be worked out by hand."""

import json

from hvt_study.report.data.document import Table
from hvt_study.runs.spec import COLUMNS

EMPTY = {"text": "", "int": None, "real": None, "yes": None}


def row(sequence, method, total_bps, named_f1=None, **own):
    """One run; a follower of M5 where ``own`` says ``matched_to``."""
    filled = {column.name: EMPTY[column.type] for column in COLUMNS}
    codec = "jpeg" if method == "M5" else ""
    filled |= {
        "key": f"{sequence}-{method}-{total_bps}",
        "dataset": "demo:0-9",
        "sequence": sequence,
        "labels": "annotations",
        "method": method,
        "regime": "low",
        "budget_bps": 800_000,
        "still_codec": codec,
        "detector": "nano",
        "edge_detector": "nano",
        "classifier": "detector",
        "matched": True,
        "accounting": "span",
        "duration_s": 10.0,
        "total_bps": total_bps,
        "named_f1": named_f1,
    }
    scheme, _, _ = own.get("dataset", filled["dataset"]).partition(":")
    filled["content"] = json.dumps({"clip": f"{scheme} {sequence}"})  # whatever else the dataset holds
    assert set(own) <= set(filled), "only columns of the table"
    return filled | own


def to_m5(**own):
    return {"matched_to": "M5", "matched_codec": "jpeg", **own}


def study():
    """M5 is ahead of M0 at its own totals by 0.10, 0.20 and 0.30; at the whole budget M0 shows more than M5."""
    rows = []
    for name, m5, m0 in (("a", 0.5, 0.4), ("b", 0.6, 0.4), ("c", 0.7, 0.4)):
        rows += [
            row(name, "M0", 800_000, 0.9),
            row(name, "M5", 600_000, m5, roi_bps=90_000, base_bps=500_000, named_f1_before=0.1),
            row(name, "M0", 601_000, m0, **to_m5(target_bps=600_000)),
            row(name, "R0", 599_000, m5 + 0.1, **to_m5(target_bps=600_000)),
        ]
    # Neither of these may move a mean: both would by far.
    rows += [
        row("d", "M5", 600_000, 0.0),
        row("d", "M0", 630_000, 1.0, **to_m5(target_bps=600_000, matched=False, failed="spends 630000 bps")),
        row("e", "M5", None, None, matched=False, failed="the edge refuses"),
    ]
    return rows


def column(table: Table, head: str) -> list:
    index = [one.text for one in table.heads].index(head)
    return [cells[index] for cells in table.rows]
