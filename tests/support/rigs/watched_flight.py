"""One flight with ``--metrics`` and a log of JSON on both sides: flown once, read by several tests."""

import json
import re
import urllib.error
import urllib.request
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Self

import yaml
from prometheus_client.parser import text_string_to_metric_families

import hvt_edge.cli
from programs.processes import Link, eventually, free_ports

STORE_BYTES = 20_000_000
PROMETHEUS = Path(__file__).resolve().parents[3] / "deploy" / "prometheus"
MAY_LACK = {"hvt_edge_temperature_celsius", "hvt_edge_wireless_dbm", "hvt_part_failed"}
"""Depends on the machine, or on what fails: declared, and without a value in most flights."""
SMALL = ("--fps", "5", "--size", "320x192", "--detector", "motion", "--edge-id", "uav-1")
_JSON = ("--log-format", "json")


def asked(address: str, path: str) -> tuple[int, str]:
    """Status and text; 0 while nobody answers."""
    try:
        with urllib.request.urlopen(f"http://{address}{path}", timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()
    except OSError:
        return 0, ""


def metrics(address: str) -> str:
    """What ``/metrics`` says; empty while that is no number, as on a machine so busy that the program stands."""
    code, text = asked(address, "/metrics")
    return text if code == 200 else ""


def state(address: str) -> dict[str, Any]:
    code, text = asked(address, "/state.json")
    found: dict[str, Any] = json.loads(text) if code == 200 else {}
    return found


def series(text: str) -> dict[str, float]:
    """Values by name of what ``/metrics`` said; of several with one name the sum."""
    found: dict[str, float] = {}
    for family in text_string_to_metric_families(text):
        for one in family.samples:
            found[one.name] = found.get(one.name, 0) + one.value
    return found


def status(*words: str) -> tuple[int, str, str]:
    """``hvt-edge status``: exit code and both outputs."""
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        code = hvt_edge.cli.main(["status", *words])
    return code, out.getvalue(), err.getvalue()


def asked_metrics() -> set[str]:
    """All that the alerts and the dashboard of deploy/prometheus ask for."""
    groups = yaml.safe_load((PROMETHEUS / "alerts.yml").read_text())["groups"]
    panels = json.loads((PROMETHEUS / "dashboard.json").read_text())["panels"]
    queries = [rule["expr"] for group in groups for rule in group["rules"]]
    queries += [target["expr"] for panel in panels for target in panel["targets"]]
    return set(re.findall(r"\bhvt_\w+", " ".join(queries)))


def with_value(text: str) -> set[str]:
    """Names that ``/metrics`` gave a value."""
    return set(re.findall(r"^(hvt_\w+)", text, re.MULTILINE))


@dataclass(frozen=True)
class Told:
    """What a program said of itself at one moment."""

    state: dict[str, Any]
    metrics: str
    healthz: tuple[int, str]
    readyz: tuple[int, str]

    @classmethod
    def by(cls, address: str) -> Self:
        return cls(state(address), metrics(address), asked(address, "/healthz"), asked(address, "/readyz"))


@dataclass(frozen=True)
class WatchedFlight:
    """What was told of an edge that waited for its ground, flew, and was stopped."""

    waiting: Told
    flying: Told
    at_ground: str
    """What ``/metrics`` said there at that time."""
    status: tuple[int, str, str]
    status_json: tuple[int, str, str]
    edge: dict[str, Any]
    logs: dict[str, str]
    """Standard error of ``edge`` and ``ground``."""
    tables: dict[str, str]
    """Standard output of both."""


def fly_watched(folder: Path, scene: Path) -> WatchedFlight:
    """Until all that Prometheus asks for has a value."""
    at_edge, at_ground = (f"127.0.0.1:{port}" for port in free_ports(2))
    store = ("--store", f"{STORE_BYTES // 10**6}MB", "--store-folder", str(folder / "store"))
    watched = ("--wait", "60", "--metrics", at_edge, *store, *_JSON)
    with Link(folder, name="watched") as link:
        edge = link.edge("--source", str(scene), "--method", "M5", "--cooldown", "0s", *SMALL, *watched)
        eventually(lambda: state(at_edge), what="it answers")
        waiting = Told.by(at_edge)
        ground = link.ground(
            "--detector", "motion", "--classifier", "none", "--once", "--metrics", at_ground, *_JSON
        )
        eventually(lambda: (state(at_edge).get("link") or {}).get("round_trip_ms"), what="it flies")
        wanted, seen = asked_metrics() - MAY_LACK, []

        def flies() -> bool:
            flying, there = Told.by(at_edge), metrics(at_ground)
            seen[:] = [(flying, there)]  # what is told now may be gone in a moment
            has_frames = series(flying.metrics).get("hvt_edge_frames_encoded_total", 0) > 10
            return has_frames and wanted <= with_value(flying.metrics + there)

        with suppress(AssertionError):  # a test tells which are lacking
            eventually(flies, what="all that is asked for has a value")
        ((flying, there),) = seen
        said = status("--at", at_edge), status("--at", at_edge, "--json")
        edge.stop()
        summary = edge.finish()
        ground.finish()
        return WatchedFlight(
            waiting,
            flying,
            there,
            *said,
            summary,
            {"edge": edge.said, "ground": ground.said},
            {"edge": edge.told, "ground": ground.told},
        )
