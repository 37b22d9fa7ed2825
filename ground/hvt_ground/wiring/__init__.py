"""From settings to objects: the parts of each session of an edge, as one tree; `sessions` names their files, too."""

from hvt_ground.perception.models import Models
from hvt_ground.perception.session import SessionPerception
from hvt_ground.wiring.sessions import (
    OpenSink,
    SessionFactory,
    check_outputs,
    make_folders,
    output_path,
    set_aside,
)
