"""Names the files of each session, and checks whether they can be written."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from itertools import count as count_from
from pathlib import Path

from hvt_common.errors import NotYetError, UserError
from hvt_common.runtime.reporting import check_writable
from hvt_ground.config import GroundConfig
from hvt_ground.extras import extras_of, written
from hvt_ground.sinks.line_file import claim_name


def check_outputs(config: GroundConfig, *, reads: Sequence[Path] = ()) -> None:
    """Refuse files that cannot be written, or are read (``reads``, too), before anything is received; `UserError`."""
    given = (
        *(config.detector, config.classifier, config.labels, config.detector_labels),
        *(config.zenoh_config,),
    )
    reads = [*reads, *(Path(one) for one in given if one is not None)]
    for extra in extras_of(config):
        reads += extra.reads(config)
    for extra in extras_of(config):
        extra.check_outputs(config)
    for name, path, suffix in written(config):
        if is_file(path, suffix):
            check_writable(path, name=name, reads=reads)
        elif path.exists() and not path.is_dir():
            raise UserError(
                f"{name} {path} is neither a folder nor named {suffix}: give FILE{suffix} or a folder"
            )


def make_folders(config: GroundConfig) -> None:
    """Comes after all that may be refused at once: a start that is refused leaves nothing behind."""
    for name, path, suffix in written(config):
        if is_file(path, suffix):
            continue
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            kind = UserError if isinstance(error, NotADirectoryError) else NotYetError
            raise kind(
                f"{name} {path} cannot be made ({error.strerror}): give FILE{suffix} or a folder"
            ) from None


def is_file(path: Path, suffix: str) -> bool:
    """Whether this path of a `Written` is one file, not a folder for some."""
    return not suffix or (path.suffix == suffix and not path.is_dir())


def output_path(
    target: Path | None, *, suffix: str, edge: str, stamp: str, taken: set[Path], claim: bool = True
) -> Path:
    """The path of a session's file, noted in ``taken``.

    ``target`` is the file or folder that the user named; ``stamp`` the time of the session's beginning. A named file
    is written anew, but each session of this process gets one of its own: the first takes the name, others have the
    edge's id in it. A file that nobody named is never overwritten. Without ``claim`` the name is but the beginning of
    others, and no file.
    """
    if target is None or not is_file(target, suffix):
        first = further = (target or Path()) / f"hvt-{edge}-{stamp}{suffix}"
    else:
        first, further = target, target.with_name(f"{target.stem}-{edge}{suffix}")
    names = [first] if further == first else [first, further]
    return free_path(names, taken, number=len(names), may_exist=target, claim=claim)


def backlog_path(target: Path | None, *, edge: str, stamp: str, taken: set[Path]) -> Path:
    """The path for the backlog of a session that is over, beside the recording of the one that is open.

    Never over another file: its edge has forgotten what is in there.
    """
    if target is not None and target.suffix == ".rrd" and not target.is_dir():
        return free_path([target.with_name(f"{target.stem}-{edge}-backlog.rrd")], taken, number=2)
    return free_path([(target or Path()) / f"hvt-{edge}-{stamp}-backlog.rrd"], taken, number=2)


def free_path(
    names: list[Path], taken: set[Path], *, number: int, may_exist: Path | None = None, claim: bool = True
) -> Path:
    """The first that is free of the names and of the last one with a number from ``number`` on; it is taken.

    With ``claim`` it is an empty file then, unless it is ``may_exist``: two grounds may share a folder.
    """
    is_free = claim_name if claim else lambda one: not one.exists()
    last = names[-1]
    numbered = (last.with_name(f"{last.stem}-{count}{last.suffix}") for count in count_from(number))
    path = next(
        one for one in chain(names, numbered) if one not in taken and (one == may_exist or is_free(one))
    )
    taken.add(path)
    return path
