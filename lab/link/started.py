"""One process of the laboratory: any command, so that it can run inside a namespace, and its output."""

import signal
import subprocess
from pathlib import Path
from typing import Any, Self

from programs.processes import Running

_END_S = 25.0


class Started(Running):
    """`Running` with any command, so that it can run inside a namespace; killed at the end of the context."""

    def __init__(self, name: str, folder: Path, command: list[str]) -> None:
        self.name = name
        self._summary = folder / f"{name}.json"
        self._out, self._err = folder / f"{name}.out", folder / f"{name}.err"
        self._summary.unlink(missing_ok=True)
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                [*command, "--summary", str(self._summary)],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
            )

    def end(self) -> int | None:
        """Ctrl-C where it still runs, then kill; the exit code, None where it had to be killed."""
        if self.alive:
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.kill()
            return None

    def left(self) -> Any:
        """Its summary; several (after an outage) as one; None where it left none."""
        if not self._summary.exists():
            return None
        content = self.summary()
        return _summed(content) if isinstance(content, list) else content

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        if self.alive:
            self.kill()


def _summed(summaries: list[dict[str, Any]]) -> dict[str, Any] | None:
    if not summaries:
        return None
    counts = {
        name: sum(one[name] for one in summaries)
        for name, value in summaries[0].items()
        if isinstance(value, int | float)
    }
    parts = {"stills": ("received",), "backlog": ("stills", "frames", "video_s")}
    return counts | {
        part: {name: sum(one[part][name] for one in summaries) for name in names}
        for part, names in parts.items()
    }
