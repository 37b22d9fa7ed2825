"""A Zenoh router between edges and grounds that cannot reach each other directly; ``zenohd`` does the same.

    python deploy/router.py --listen tls/0.0.0.0:7447 --zenoh-config FILE.json5

It forwards, and looks into nothing. SIGINT and SIGTERM end it with exit code 0, wrong settings with 2.
"""
# ruff: noqa: RUF009  (a script beside its configuration; settings are declared by calls that return fields)

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import zenoh

from hvt_common.config import PATH, TEXT, Group, load, to_toml
from hvt_common.errors import UserError, exit_with_sentence
from hvt_common.runtime.failures import Failures
from hvt_common.transport.link_doctor import link_doctor
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings, configure

PROGRAM = "hvt-router"
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_ANEW = signal.SIGHUP
"""A listener hears nothing any more: another session."""


_ALL = Group()


@dataclass(frozen=True, slots=True)
class RouterConfig:
    """What the router runs with. See ``--help`` for each."""

    zenoh_config: Path = _ALL.option(
        PATH, Path(__file__).parent / "zenoh" / "router.json5", "Zenoh configuration, JSON5, with mode router"
    )
    listen: tuple[str, ...] = _ALL.option(
        TEXT, (), "Zenoh endpoint to listen on, instead of those of the file", many=True
    )
    connect: tuple[str, ...] = _ALL.option(TEXT, (), "another router to connect to", many=True)
    insecure: bool = _ALL.switch("allow listening beyond this machine without keys")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the router until a signal; the exit code."""
    return exit_with_sentence(run, program=PROGRAM, argv=argv)


def run(argv: Sequence[str] | None) -> int:
    """Route until SIGINT or SIGTERM. Raises `UserError` for settings that cannot be used."""
    config, loaded = load(RouterConfig, argv, program=PROGRAM, description=__doc__ or "")
    if loaded.print_config:
        print(to_toml(config), end="")
        return 0
    settings = LinkSettings(
        role="ground",
        listen=config.listen,
        connect=config.connect,
        zenoh_config=config.zenoh_config,
        insecure=config.insecure,
    )
    zenoh_settings, listen = configure(settings)
    mode = zenoh_settings.get_json("mode")
    if mode != '"router"':
        raise UserError(f'{config.zenoh_config} says mode {mode}: a router needs mode: "router"')
    zenoh.init_log_from_env_or("error")
    # Blocked before Zenoh starts its threads, so that the signals wait for sigwait and reach nobody else.
    signal.pthread_sigmask(signal.SIG_BLOCK, (*STOP_SIGNALS, _ANEW))
    failures = None  # at the start a port that is in use ends it
    while True:
        with (
            open_session(settings, failures=failures, on_deaf=lambda: os.kill(os.getpid(), _ANEW)) as session,
            link_doctor().watch(session, settings, served=lambda _name: True),
        ):
            print(f"{PROGRAM} {session.zid()} listens on {', '.join(listen) or 'nothing'}", flush=True)
            if signal.sigwait((*STOP_SIGNALS, _ANEW)) != _ANEW:
                return 0
        failures = failures or Failures(time.time_ns)


if __name__ == "__main__":
    sys.exit(main())
