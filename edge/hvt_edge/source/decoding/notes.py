"""Decisions about a source and their reasons: before the flight for its opener, in flight for the log."""

from __future__ import annotations

import logging

from hvt_common.runtime.log import START_LOGGER


class Notes:
    """Takes sentences; ``name`` is their subject, as it may be printed."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._said: list[str] = []
        self._taken = False

    def __call__(self, sentence: str) -> None:
        """Keep it, each once; after `taken` it is logged at once."""
        if sentence in self._said:
            return
        self._said.append(sentence)
        if self._taken:
            logging.getLogger(START_LOGGER).info("%s: %s", self._name, sentence)

    def taken(self) -> tuple[str, ...]:
        """All of them so far."""
        self._taken = True
        return tuple(self._said)
