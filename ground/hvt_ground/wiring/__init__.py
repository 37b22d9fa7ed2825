"""From settings to objects: the parts of each session of an edge, as one tree; `files` names what they write."""

from hvt_ground.perception.models import Models
from hvt_ground.perception.session import SessionPerception
from hvt_ground.wiring.files import check_outputs, make_folders, output_path
from hvt_ground.wiring.sessions import OpenSink, SessionFactory
