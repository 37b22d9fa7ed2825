"""The log as programs read it: one JSON object a line, of real flights and of programs that fail."""

import json
from datetime import datetime

import pytest

from hvt_edge.cli import main
from programs.processes import python

pytestmark = pytest.mark.integration

JSON = ("--log-format", "json")


def lines(said):
    return [json.loads(line) for line in said.splitlines()]


def test_a_flight_is_told_in_objects_on_both_sides(watched):
    """A collector of logs would have to guess at what people read."""
    flown, received = lines(watched.logs["edge"]), lines(watched.logs["ground"])
    summary = watched.edge
    assert set(watched.tables.values()) == {""}, "the table is for people"
    assert {(one["program"], one["edge"], one["session"]) for one in flown} == {
        ("hvt-edge", "uav-1", summary["session"])
    }
    assert all(datetime.fromisoformat(one["time"]).utcoffset().seconds == 0 for one in flown + received)
    assert any("a ground listens" in one["message"] for one in flown if one["logger"] == "hvt.status")
    assert flown[-1]["summary"] == summary
    assert received[-1]["summary"][0]["session"] == summary["session"]
    assert {one["level"] for one in flown} <= {"info", "warning"}, "a busy machine is told of"


EDGES = """
import logging, threading
from hvt_common.runtime.log import log_fields, start_log
log = start_log("hvt-ground", quiet=True, form="json")
def serve(edge):
    log_fields(edge=edge, session="1f")
    logging.getLogger("hvt_ground.link").warning("%s: damaged", edge)
    log_fields(session="")
    logging.getLogger("hvt_ground.link").warning("%s: ended", edge)
for edge in ("uav-1", "uav-2"):
    thread = threading.Thread(target=serve, args=(edge,))
    thread.start()
    thread.join()
logging.getLogger("hvt_ground").warning("of none")
log.release()
"""


def test_a_line_of_one_edge_names_it():
    """Of a ground of many edges nobody could tell whose line it is."""
    told = [(one["message"], one.get("edge"), one.get("session")) for one in lines(python(EDGES).stderr)]
    of_edges = [
        (f"{edge}: {what}", edge, session)
        for edge in ("uav-1", "uav-2")
        for what, session in (("damaged", "1f"), ("ended", None))
    ]
    assert told == [*of_edges, ("of none", None, None)]


@pytest.mark.parametrize(
    ("words", "said"),
    [(("--source", "none.mp4"), "none.mp4"), (("--source", "demo", "--metrics", "none"), "--metrics 'none'")],
)
def test_what_ends_a_start_is_one_object(capsys, words, said):
    """The one line that says why a service does not run would be the one that the collector drops."""
    assert main([*words, *JSON]) == 2
    (line,) = lines(capsys.readouterr().err)
    assert said in line["message"]
    assert (line["level"], line["edge"]) == ("error", "edge-1")


BUG = """
import threading
from hvt_common.runtime.log import start_log
log = start_log("hvt-edge", quiet=True, form="json", edge="uav-1")
def bug():
    raise ValueError("of a thread")
thread = threading.Thread(target=bug)
thread.start()
thread.join()
raise KeyError("of the program")
"""


def test_a_traceback_is_inside_its_object():
    """Each of its lines would be an entry of its own, between those of other services."""
    first, second = lines(python(BUG, check=False).stderr)
    assert "ValueError: of a thread" in first["traceback"]
    assert second["traceback"].startswith("Traceback")
    assert (first["level"], second["message"]) == ("critical", "KeyError: 'of the program'")
