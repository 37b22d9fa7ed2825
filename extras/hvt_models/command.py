"""``hvt-models``: which models there are, and getting them onto this machine."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from hvt_common import __version__
from hvt_common.errors import Parser, UserError, exit_with_sentence
from hvt_common.inference.heads import HEAD_NAMES
from hvt_common.inference.runtimes.plug_in import plug_in_names
from hvt_common.inference.store import EMBEDDED_CLASSIFIER, EMBEDDED_DETECTOR, embedded_models, resolve_model
from hvt_common.runtime.process import interrupt_on_signals
from hvt_models.manifest import ModelEntry
from hvt_models.store import Store, file_digest

_PROGRAM = "hvt-models"
_SHOWN_CLASSES = 12
_EMBEDDED = {
    EMBEDDED_DETECTOR: ("detector", "part of HVT: vehicles and people, aerial"),
    EMBEDDED_CLASSIFIER: ("classifier", "part of HVT: crops of vehicles and people, aerial"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``hvt-models``; 0, or 2 after one sentence on stderr where the user can mend something."""
    interrupt_on_signals()
    return exit_with_sentence(_run, program=_PROGRAM, argv=argv)


def _run(argv: Sequence[str] | None) -> int:
    arguments = _parser().parse_args(argv)
    code: int = arguments.run(arguments)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=_PROGRAM,
        description="Models for --detector and --classifier: fetched once, checked at each use. "
        "They lie in the folder that HVT_MODELS names, else in the platform's cache folder.",
    )
    parser.add_argument("--version", action="version", version=f"{_PROGRAM} {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    one = commands.add_parser("list", help="every model that has a name, and what is here of it")
    one.set_defaults(run=_list)

    one = commands.add_parser("fetch", help="download models; goes on where a download broke off")
    one.add_argument("names", nargs="+", metavar="NAME")
    one.set_defaults(run=_fetch)

    one = commands.add_parser(
        "verify", help="check size and SHA-256 of models, by default of all that are here"
    )
    one.add_argument("names", nargs="*", metavar="NAME")
    one.set_defaults(run=_verify)

    one = commands.add_parser("path", help="check a model and print where it lies")
    one.add_argument("name", metavar="NAME")
    one.set_defaults(run=_path)

    one = commands.add_parser(
        "add", help="take in a file that was brought by hand, the .bin beside an .xml too"
    )
    one.add_argument("file", type=Path, metavar="FILE")
    one.add_argument(
        "--name", required=True, help="a name of 'hvt-models list', or a new one: a-z, 0-9 and -"
    )
    one.add_argument(
        "--sha256",
        metavar="DIGEST",
        help="what its origin says; needed for a new name, which it pins; of .xml and .bin by a comma",
    )
    one.set_defaults(run=_add)

    one = commands.add_parser("info", help="ports, adapter, classes and speed of a model")
    one.add_argument("file", metavar="FILE", help="an ONNX file, OpenVINO's .xml, or the name of a model")
    one.add_argument("--head", metavar="NAME", help=f"as of --detector's programs: {', '.join(HEAD_NAMES)}")
    one.add_argument(
        "--labels", type=Path, metavar="FILE", help="class names, one a line, or coco or visdrone"
    )
    one.add_argument("--provider", default="cpu", help="what runs it: auto, cpu, openvino … [cpu]")
    one.add_argument("--threads", type=int, choices=range(1, 65), default=1, metavar="N", help="threads [1]")
    one.set_defaults(run=_info)
    return parser


def _list(_: argparse.Namespace) -> int:
    store = Store()
    table = Table(title=f"models in {store.folder}", title_justify="left", title_style="bold")
    for column in ("name", "task", "MB", "licence", "here", "about"):
        table.add_column(column, justify="right" if column == "MB" else "left", no_wrap=column == "name")
    for name, path in embedded_models().items():
        task, about = _EMBEDDED[name]
        table.add_row(name, task, f"{path.stat().st_size / 1e6:.1f}", "Apache-2.0", "yes", about)
    for name, entry in store.entries.items():
        held = store.held_bytes(name)
        here = "yes" if store.is_there(name) else f"{100 * held // entry.total_bytes} %" if held else "no"
        table.add_row(
            name,
            entry.task,
            f"{entry.total_bytes / 1e6:.1f}",
            entry.licence,
            here,
            entry.about or "added by hand",
        )
    for name, origin in plug_in_names().items():
        table.add_row(name, "detector", "", "", "yes", f"plug-in of {origin}")
    Console(highlight=False, markup=False).print(table)
    print("hvt-models fetch NAME brings one here; then --detector NAME or --classifier NAME takes it")
    return 0


def _fetch(arguments: argparse.Namespace) -> int:
    store = Store()
    entries = list(map(store.entry, arguments.names))  # a wrong name is said before anything is fetched
    console = Console(stderr=True, highlight=False)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    for entry in entries:
        with Progress(*columns, console=console) as bar:
            print(_with_progress(store, entry, bar))
    return 0


def _with_progress(store: Store, entry: ModelEntry, bar: Progress) -> Path:
    task = bar.add_task(entry.name, total=entry.total_bytes)

    def say_waits() -> None:
        bar.console.print(f"another process fetches {entry.name}; waiting for it")

    path = store.fetch(entry.name, progress=lambda held: bar.update(task, completed=held), on_wait=say_waits)
    bar.update(task, completed=entry.total_bytes)
    return path


def _verify(arguments: argparse.Namespace) -> int:
    store = Store()
    names = arguments.names or [name for name in store.entries if store.is_there(name)]
    for name in names:
        store.entry(name)  # a wrong one is said before anything is read
    if not names:
        print(f"no models in {store.folder}")
    wrong = 0
    for name in names:
        try:
            store.verified(name)
            print(f"{name}: size and SHA-256 are right")
        except UserError as error:
            print(f"{_PROGRAM}: {error}", file=sys.stderr)
            wrong += 1
    return 2 if wrong else 0


def _path(arguments: argparse.Namespace) -> int:
    print(resolve_model(arguments.name).absolute())
    return 0


def _add(arguments: argparse.Namespace) -> int:
    print(Store().add(arguments.file, name=arguments.name, sha256=arguments.sha256))
    return 0


def _info(arguments: argparse.Namespace) -> int:
    from hvt_models.inspect import inspect_model  # noqa: PLC0415  (the other commands open no model)

    report = inspect_model(
        resolve_model(arguments.file),
        provider=arguments.provider,
        threads=arguments.threads,
        head=arguments.head,
        labels=arguments.labels,
    )
    names, model = report.class_names, report.model
    shown = ", ".join(names[:_SHOWN_CLASSES]) + (" …" if len(names) > _SHOWN_CLASSES else "")
    rows = [
        ("file", str(model.path)),
        ("size", f"{report.size_bytes} bytes"),
        ("SHA-256", file_digest(model.path)),
        *(("opset", f"{domain or 'ai.onnx'} {version}") for domain, version in report.opsets.items()),
        *(("input", str(port)) for port in model.inputs),
        *(("output", str(port)) for port in model.outputs),
        *((f"metadata {key}", value[:80]) for key, value in model.metadata.items()),
        ("adapter", report.adapter),
        ("because", report.because),
        ("classes", f"{len(names)}: {shown}" if names else "none"),
        ("provider", f"{model.provider.provider} ({model.provider.why})"),
    ]
    if report.median_ms is not None:
        rows.append(
            ("time here", f"{report.median_ms:.1f} ms for {report.timing} ({arguments.threads} threads)")
        )
    table = Table(show_header=False, box=None)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console(highlight=False, markup=False).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
