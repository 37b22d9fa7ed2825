"""Flies edge and ground in one process, in lockstep over a simulated serial link: `fly` and `dry_run`."""
