"""Frees memory and threads that the Rerun SDK keeps, and lets it do one thing at a time.

Each recording would leave four threads and two megabytes behind, and 15 kB of paths, which the SDK never forgets. A
ground opens a recording for each session and each return after a long outage, so this has to be flat over weeks. And
two recordings that begin and end at the same moment would stop the process for ever: to free one the SDK holds the
lock of its list, and waits for threads of its own that want Python's; to make one it holds Python's, and
waits for the list's. So one thread at a time makes recordings or lets go of them.

Measured with rerun-sdk 0.41; `tests/ground/sinks/rerun/test_sdk.py` holds it to that. The names it takes for that
are the SDK's own, so pyproject pins the version.
"""

from __future__ import annotations

import os
import sys
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from pathlib import Path

import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings as bindings

from hvt_common.errors import UserError

_list_of_recordings = threading.RLock()


@dataclass(frozen=True, slots=True)
class RecordingId:
    """The edge and session of a recording: files with the same are shown as one."""

    edge: str
    session: str

    @property
    def application(self) -> str:
        """The viewer has one screen for each application: one for all edges would be the last one's."""
        return f"hvt-{self.edge}"


def leave_out_pandas() -> None:
    """Keep Arrow from importing pandas where that is installed: 50 MB, and nothing of it is used here.

    Arrow, in which the SDK writes, looks for it once in a process, at the first list that it converts: here. For
    processes that convert nothing to pandas themselves.
    """
    finder = _NoPandas()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)


class _NoPandas(MetaPathFinder):
    def find_spec(self, fullname: str, *_: object) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError(fullname, name=fullname)


def new_recording(one: RecordingId) -> rr.RecordingStream:
    """A recording without the SDK's own two timelines, which would cost bytes and mean nothing here."""
    with _list_of_recordings, _switched_on():
        recording = rr.RecordingStream(
            one.application, recording_id=f"{one.edge}-{one.session}", send_properties=False
        )
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    return recording


@contextmanager
def _switched_on() -> Iterator[None]:
    # ``RERUN=off`` is the SDK's switch for other programs: a recording that begins with it stays empty.
    switch = os.environ.pop("RERUN", None)
    try:
        yield
    finally:
        if switch is not None:
            os.environ["RERUN"] = switch


def send_blueprint(recording: rr.RecordingStream, one: RecordingId, blueprint: rrb.Blueprint) -> None:
    """Send the blueprint and make it active: the SDK's own function never frees the stream that it writes it to."""
    _number(blueprint.root_container, "hvt")
    # As rerun.sinks.send_blueprint has it, but for the end: stream and storage hold each other until then.
    with releasing_recordings(), _switched_on():
        stream = rr.RecordingStream._from_native(  # noqa: SLF001
            bindings.new_blueprint(
                application_id=one.application,
                make_default=False,
                make_thread_default=False,
                default_enabled=True,
            )
        )
        stream.set_time("blueprint", sequence=0)
        blueprint._log_to_stream(stream)  # noqa: SLF001
        bindings.send_blueprint(stream.memory_recording().storage, True, True, recording.to_native())
        stream.disconnect()
        del stream


def _number(part: rrb.Container | rrb.View, place: str) -> None:
    # An id is part of a dozen paths, and by default another in each blueprint.
    part.id = uuid.uuid5(uuid.NAMESPACE_OID, place)
    if isinstance(part, rrb.Container):
        for index, one in enumerate(part.contents):
            _number(one, f"{place}/{index}")
        return
    for path, shown in part.visualizer_overrides.items():
        if isinstance(shown, rrb.Visualizer):
            shown.id = uuid.uuid5(part.id, str(path))


@contextmanager
def releasing_recordings() -> Iterator[None]:
    """Disconnect recordings in it and ``del`` the last reference to them: they are freed at its end."""
    with _list_of_recordings:
        yield
        # It flushes all recordings first, and raises where the viewer of any is gone: that is not this one's fault.
        # The next release frees the rest.
        with suppress(RuntimeError):
            bindings.flush_and_cleanup_orphaned_recordings()


def viewer_program() -> Path:
    """The viewer that came with the SDK; `UserError` where the installation lacks it."""
    program = Path(rr.__file__).parent.parent / "rerun_cli" / ("rerun.exe" if os.name == "nt" else "rerun")
    if not program.is_file():
        raise UserError(f"the Rerun viewer is missing at {program}: install rerun-sdk from its wheel")
    return program


def viewer_environment() -> dict[str, str]:
    """The environment for the viewer. ``CI`` keeps its analytics off without touching the user's own settings."""
    return {**os.environ, "CI": "1", "RUST_LOG": os.environ.get("RUST_LOG", "error")}
