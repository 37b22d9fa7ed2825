"""``python -m hvt_train``: train the embedded models, or measure them."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from hvt_common.errors import UserError, exit_with_sentence, needs_extra, telling
from hvt_common.files import MOST_TABLE_BYTES, read_text
from hvt_common.inference.runtimes.model_file import check_onnx_file
from hvt_common.inference.store import EMBEDDED_CLASSIFIER as CLASSIFIER
from hvt_common.inference.store import EMBEDDED_DETECTOR as DETECTOR
from hvt_common.inference.store import embedded_models
from hvt_common.runtime.process import interrupt_on_signals
from hvt_common.runtime.reporting import check_writable

_PROGRAM = "python -m hvt_train"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; 0, or 2 after one sentence on stderr where the user can mend something."""
    interrupt_on_signals()
    return exit_with_sentence(_run, program=_PROGRAM, argv=argv)


def _run(argv: Sequence[str] | None) -> int:
    arguments = _parser().parse_args(argv)
    for name in ("seeds", "every", "threads"):
        if getattr(arguments, name, 1) < 1:
            raise UserError(f"--{name} is {getattr(arguments, name)}, must be at least 1")
    return {"eval": _evaluate, "curve": _curve, "join": _join}.get(arguments.command, _train)(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=_PROGRAM, description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, what in (
        ("detector", f"train {DETECTOR}"),
        ("classifier", f"train {CLASSIFIER}"),
        ("all", "train both"),
    ):
        own = commands.add_parser(name, help=what, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
        own.add_argument("--out", type=Path, required=True, default=argparse.SUPPRESS, metavar="FOLDER")
        own.add_argument("--seed", type=int, default=1)
        own.add_argument("--threads", type=int, default=2, help="of PyTorch")
        own.add_argument("--workers", type=int, default=1, help="processes that draw")
        own.add_argument("--scenes", type=int, default=102, help="demo scenes in the pool")
        own.add_argument("--codes", type=int, default=120, help="more of them, with codes on roofs")
        own.add_argument("--places", type=int, default=323, help="other places in the pool")
        own.add_argument("--aslant", type=int, default=160, help="places seen aslant")
        own.add_argument("--crop-scenes", type=int, default=45, help="demo scenes that stills are cut from")
        own.add_argument("--rate", type=float, default=2e-3, help="greatest learning rate")
        own.add_argument("--steps", type=int, default=9000, help="of the detector")
        own.add_argument("--batch", type=int, default=8, help="views in a step of the detector")
        own.add_argument("--classifier-steps", type=int, default=5000, help="of 64 crops each")
        own.add_argument("--minutes", type=float, default=None, help="end each network's schedule by then")
        real = "folder of kit_ais, hit_uav, cats_madison, seadronessee, and of street and camera (unlabelled)"
        own.add_argument("--real", type=Path, default=None, metavar="DATA", help=real)
        named = ("PVB_2003.xml", "YOLOX_NANO.onnx")
        own.add_argument(
            "--teachers", type=Path, nargs=2, metavar=named, help="name what is in street and camera"
        )
        own.add_argument("--start", metavar="embedded|FOLDER|FILE", help="ONNX files to go on from")
    own = commands.add_parser("eval", help="measure", formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    own.add_argument("--drawn", action="store_true", help="on held-out drawn scenes")
    own.add_argument("--real", type=Path, metavar="CLIP", help="on a real clip, against --reference")
    own.add_argument("--reference", type=Path, metavar="MODEL", help="detector whose boxes count as true")
    own.add_argument("--speed", action="store_true", help="milliseconds at 640x384 on one thread")
    own.add_argument("--detector", type=Path, default=embedded_models()[DETECTOR])
    own.add_argument("--classifier", type=Path, default=embedded_models()[CLASSIFIER])
    own.add_argument("--seeds", type=int, default=8, help="held-out scenes")
    own.add_argument("--every", type=int, default=10, help="frames of the clip: every n-th")
    own.add_argument("--threads", type=int, default=1)
    own = commands.add_parser("join", help=f"make the embedded {DETECTOR} of a trained one and YOLOX-nano")
    own.add_argument("aerial", type=Path, metavar="TRAINED.onnx")
    street = "`hvt-models fetch yolox-nano` has it"
    own.add_argument("street", type=Path, metavar="YOLOX_NANO.onnx", help=street)
    own.add_argument("--out", type=Path, required=True, metavar="FILE.onnx")
    own = commands.add_parser("curve", help="draw the training curve of a log")
    own.add_argument("log", type=Path)
    own.add_argument("--out", type=Path, required=True, metavar="SVG")
    own.add_argument("--title", default="")
    own.add_argument("--quality", default="validation")
    return parser


def _join(arguments: argparse.Namespace) -> int:
    with needs_extra("onnx"):
        from hvt_train.join import join  # noqa: PLC0415

    for path in (arguments.aerial, arguments.street):
        check_onnx_file(path)
    join(arguments.aerial, arguments.street, arguments.out)
    return 0


def _curve(arguments: argparse.Namespace) -> int:
    """Loss (left axis) and the measures of the checks (right axis, 0…1) over the steps of a training log, as SVG."""
    with needs_extra("'hvt[study]'"):
        import matplotlib as mpl  # noqa: PLC0415
        from matplotlib.figure import Figure  # noqa: PLC0415

    with telling(f"--out {arguments.out} cannot be made (", "): name a file"):
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
    check_writable(arguments.out, name="--out", reads=[arguments.log])
    with telling(f"{arguments.log} cannot be read (", "): the log of a training run is expected"):
        lines = read_text(arguments.log, most=MOST_TABLE_BYTES).splitlines()
    rows = [_row(arguments.log, *numbered) for numbered in enumerate(lines, 1)]
    if not any("loss" in row for row in rows):
        raise UserError(f"{arguments.log} has no loss: the log of a training run is expected")
    figure = Figure(figsize=(7.2, 3), layout="constrained")
    left = figure.subplots()
    right = left.twinx()
    for axes, name, label, style in (
        (left, "loss", "loss", "-"),
        (right, "validation", arguments.quality, ".-"),
    ):
        points = [(row["step"], row[name]) for row in rows if name in row]
        colour = "#3060b0" if axes is left else "#c04020"
        axes.plot(*zip(*points, strict=True), style, color=colour)
        axes.set_ylabel(label, color=colour)
        axes.set_ylim(0)
    right.set_ylim(0, 1)
    left.set_xlabel("steps")
    left.set_title(arguments.title)
    with mpl.rc_context({"svg.hashsalt": arguments.title}):
        figure.savefig(arguments.out, format="svg", metadata={"Date": None})
    return 0


def _row(log: Path, number: int, line: str) -> dict[str, float]:
    try:
        row = json.loads(line)
        return {
            name: float(row[name]) for name in ("step", "loss", "validation") if name in row or name == "step"
        }
    except (ValueError, TypeError, KeyError, RecursionError):
        raise UserError(f'{log}, line {number} is {line[:60]!r}; accepted is {{"step": 50, …}}') from None


def _train(arguments: argparse.Namespace) -> int:
    with needs_extra("torch onnx"):
        from hvt_train.recipe import run_recipe  # noqa: PLC0415  # PyTorch is needed for this alone
    run_recipe(arguments)
    return 0


def _evaluate(arguments: argparse.Namespace) -> int:
    from hvt_train.evaluate import print_drawn, print_real, print_speed  # noqa: PLC0415

    if not (arguments.drawn or arguments.real or arguments.speed):
        raise UserError("eval has nothing to do; give --drawn, --speed, or --real with --reference")
    if (arguments.real is None) != (arguments.reference is None):
        raise UserError(
            "--real and --reference belong together: a clip, and the model whose boxes count as true"
        )
    if arguments.speed:
        print_speed(arguments.detector)
    if arguments.drawn:
        print_drawn(
            arguments.detector, arguments.classifier, seeds=arguments.seeds, threads=arguments.threads
        )
    if arguments.real:
        print_real(arguments.detector, arguments.real, arguments.reference, every=arguments.every)
    return 0


if __name__ == "__main__":
    sys.exit(main())
