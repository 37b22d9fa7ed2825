"""Flies edge and ground in one process, in lockstep over a simulated serial link: `fly`, `dry_run`, `FlightPlan`."""
