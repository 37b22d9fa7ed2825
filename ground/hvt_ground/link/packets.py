"""The parsed messages of an edge, from the receiver to its sessions."""

from __future__ import annotations

from dataclasses import dataclass

from hvt_common.protocol.messages import BacklogHeader, PoseReport, RoiHeader, Status, TrackStep
from hvt_common.transport.inbox import Received
from hvt_ground.link.reassemble import Arrival


@dataclass(frozen=True, slots=True)
class BasePacket:
    """An access unit that the reassembly has judged, with its own bytes even if it waited behind a hole."""

    arrival: Arrival
    item: Received
    on_time: bool
    """It did not wait: the time of ``item`` is its own."""


@dataclass(frozen=True, slots=True)
class Packet:
    """Any other message."""

    header: RoiHeader | TrackStep | PoseReport | BacklogHeader | Status
    item: Received
