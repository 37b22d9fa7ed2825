"""The subcommands of ``hvt-study``, one module each, with `add_arguments` and `run`; `COMMANDS` names them."""

from __future__ import annotations

from typing import Final

__all__ = ["COMMANDS", "RENAMED"]

COMMANDS: Final = {
    "plan": "Say how many runs, bytes and hours `hvt-study run` with the same arguments would take.",
    "compare": "Fly every method at every rate over a clip and say what the ground shows.",
    "read": "Read codes on roofs at the ground with each method, for the same bits; needs hvt[reading].",
    "demo": "Compare flights of the drawn scene that hvt-edge and hvt-ground left in a folder: a table, a picture.",
    "run": "Fly every method at every budget on datasets, at matched totals; write results.parquet and a report.",
    "report": "Make report.html, report.md and figures again from a study's results.parquet, or of several joined.",
    "tune": "Search for a method's parameters on some sequences; report what they are worth on others.",
    "score": "Score the tracks of hvt-ground --tracks against ground truth.",
    "sweep": "Apply the pilot's four selectors to raw detections and print what each keeps.",
    "detect": "Detect on pictures; score labelled ones and show the worst false alarms and misses.",
    "train": "Teach the embedded detector your own objects, from your labelled pictures; needs PyTorch.",
    "track": "Run ByteTrack over a MOTChallenge file of detections.",
}
"""One line each for ``hvt-study --help``. A module is imported when its command is given: needs differ."""

RENAMED: Final = {"sight": "compare"}  # the former name works for one release
