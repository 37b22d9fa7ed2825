"""All targets by name."""

from hvt_common.protocol.channels import parse_key
from lab.fuzz import (
    file_targets,
    ground_target,
    message_targets,
    picture_targets,
    stage_targets,
    text_targets,
)
from lab.fuzz.contract import Target


def _planted(data: bytes) -> None:
    parse_key(data.decode("latin-1"))
    if b"t" in data:
        raise ValueError("this one is here to be found")


PLANTED = Target("planted", _planted, lambda: [b"hv", b"HVT"], share=0, most_bytes=16)
"""A bug, for the fuzzer's own test."""

TARGETS = {
    target.name: target
    for target in (
        *message_targets.TARGETS,
        *stage_targets.TARGETS,
        *picture_targets.TARGETS,
        *text_targets.TARGETS,
        *file_targets.TARGETS,
        *ground_target.TARGETS,
        PLANTED,
    )
}
