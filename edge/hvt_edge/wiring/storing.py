"""Makes the files of the edge, from the settings."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from pathlib import Path
from typing import cast

from hvt_common.errors import UserError, check_apart
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.plug_ins import brought
from hvt_common.runtime.reporting import check_folder, check_writable
from hvt_edge.config import EdgeConfig
from hvt_edge.source.folder import names_picture
from hvt_edge.video.stage import LocalCopy

_COPIES = "hvt.edge_copies"


def check_files(config: EdgeConfig) -> None:
    """Raise `UserError` for a file or folder that cannot be written, or is also read, or belongs to another edge."""
    given = (config.source, config.pose, config.detector, config.labels, config.zenoh_config)
    reads = [Path(one) for one in given if one is not None]
    files = (("--summary", config.summary), ("--truth", config.truth), ("--record-base", config.record_base))
    pictures = Path(os.path.realpath(config.source or ""))  # also of a link to itself
    for name, path in files:
        if path is not None and names_picture(path) and path.resolve().parent == pictures:
            raise UserError(
                f"{name} {path} would be a picture of --source {config.source}: name another file"
            )
        check_writable(path, name=name, reads=reads)
    check_apart(files)


def open_local_copy(path: Path, *, failures: Failures, wait: bool) -> AbstractContextManager[LocalCopy]:
    """An extra's writer of the base stream to a file; ``wait``: it blocks where the card is slower (lockstep)."""
    copy = brought(
        _COPIES,
        "base",
        what="local copy",
        option="--record-base",
        package="hvt[edge]",
        make=lambda opens: opens(path, failures=failures, wait=wait),
    )
    return cast("AbstractContextManager[LocalCopy]", copy)


def store_folder(config: EdgeConfig) -> Path:
    return config.store_folder or default_folder(config.edge_id)


def default_folder(edge_id: str) -> Path:
    """The platform's folder for state: ``$XDG_STATE_HOME`` or ``~/.local/state``, then ``hvt/<edge>``."""
    state = os.environ.get("XDG_STATE_HOME", "")
    if Path(state).is_absolute():
        return Path(state) / "hvt" / edge_id
    try:
        return Path.home() / ".local" / "state" / "hvt" / edge_id
    except RuntimeError:
        raise UserError(
            "what is captured while the link is down has no place, because there is no home folder: give "
            "--store-folder, or --store 0 to store nothing"
        ) from None


def check_store(config: EdgeConfig, *, live: bool) -> None:
    """Raise `UserError` now if a store could not be made in mid-flight; makes nothing."""
    if config.store_bytes(live=live):
        check_folder(
            store_folder(config), name="--store-folder", otherwise=", or give --store 0 to store nothing"
        )
