"""The contract of a fuzzing target."""

import atexit
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from tempfile import mkdtemp

from lab.fuzz.mutate import Bytes, Mutator


def raw_bytes(data: bytes, rng: Random, raw: Bytes) -> bytes:
    """The input has no structure that a mutation should keep."""
    return raw(data)


@dataclass(frozen=True, slots=True)
class Target:
    """One way in. ``run`` takes any bytes and raises nothing that the code under it does not promise.

    Promised exceptions (`WireError`, `StillError`, `UserError`) are caught inside ``run``; any other one is a
    finding.
    """

    name: str
    run: Callable[[bytes], None]
    seeds: Callable[[], Sequence[bytes]]
    """From the real encoders."""
    mutate: Mutator = raw_bytes
    share: int = 10
    """Weight in the inputs of a run over all targets."""
    short: int = 2000
    """Inputs in the normal tests: at least a hundred, in some tenths of a second where that can be."""
    most_bytes: int = 4096
    most_growth_mb: int = 64
    """By so much one input may raise the process's peak of memory."""


class CannotStartError(Exception):
    """A target whose seeds cannot be made, or are findings themselves: not one of its inputs would be tried."""


def checked_seeds(target: Target) -> list[bytes]:
    """The target's seeds, each of which has run once; `CannotStartError` where one has not."""
    try:
        seeds = list(target.seeds())
        for seed in seeds:
            target.run(seed)
    except Exception as error:  # whatever it is, the target is of no use
        raise CannotStartError(f"target {target.name} cannot start: {error!r:.300}") from error
    if not seeds:
        raise CannotStartError(f"target {target.name} cannot start: it has no seeds")
    return seeds


@cache
def scratch() -> Path:
    """A folder for the files that targets write, the same each time; gone when the process ends."""
    folder = Path(mkdtemp(prefix="hvt-fuzz-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
