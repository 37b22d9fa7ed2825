"""``hvt-study``: the command line of the study."""

import argparse
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Final

from hvt_common import __version__
from hvt_common.errors import Parser, exit_with_sentence, needs_extra
from hvt_common.runtime.process import interrupt_on_signals

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
_PROGRAM = "hvt-study"
_DATASET = re.compile(r"[a-z]+:(?!//)[^@]*", re.DOTALL)
"""``still:pictures?labelled=car``: a folder and options, no address."""


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Says a default once, and none where there is none."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        none = action.default in (None, "", []) or "(default" in (action.help or "")
        return action.help if none else super()._get_help_string(action)


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``hvt-study``; 0, or 2 after one sentence on stderr where the user can mend something."""
    interrupt_on_signals()
    return exit_with_sentence(_run, program=_PROGRAM, argv=argv, local=_DATASET)


def _run(argv: Sequence[str] | None) -> int:
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in RENAMED:
        now = RENAMED[words[0]]
        print(f"{_PROGRAM}: {words[0]} is called {now} from this release on", file=sys.stderr)
        words[0] = now
    parser = Parser(prog=_PROGRAM, description="Experiments with the stages of HVT, without a network.")
    parser.add_argument("--version", action="version", version=f"{_PROGRAM} {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    with needs_extra("'hvt[study]'"):
        for name, summary in COMMANDS.items():
            own = commands.add_parser(
                name,
                help=summary,
                description=summary,
                formatter_class=_Help,
            )
            if name in words[:1]:
                command = import_module(f"hvt_study.commands.{name}")
                command.add_arguments(own)
        arguments = parser.parse_args(words)
        return int(command.run(arguments))


if __name__ == "__main__":
    sys.exit(main())
