"""Builds every part of an edge once, each from the settings and from the parts it needs."""

from hvt_edge.wiring.link import make_link_settings
from hvt_edge.wiring.perception import check_codecs, make_detector, open_for_flight, unopened, warm_up_for
from hvt_edge.wiring.stages import Flight, Stages
from hvt_edge.wiring.storing import check_files, check_store, store_folder
from hvt_edge.wiring.trial import Beginning, try_scene
from hvt_edge.wiring.video import (
    Camera,
    base_size,
    default_size,
    first_decimation,
    first_rates,
    make_encoder,
    passthrough,
    qualify_encoder,
    say_size,
    surveyed,
)
