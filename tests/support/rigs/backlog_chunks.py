"""What an edge sends of what it kept, as the link delivers it: objects of a real flight, cut into chunks."""

import time
from collections.abc import Sequence

from hvt_common.protocol.channels import MSGPACK_ENCODING
from hvt_common.protocol.messages import (
    BacklogHeader,
    BacklogStill,
    BacklogUnit,
    Flags,
    pack_backlog_still,
    pack_backlog_units,
)
from hvt_common.transport.inbox import Received
from rigs.flight import Flight


def still_object(flight: Flight, index: int, sequence: int, **changes) -> bytes:
    changes = {"flags": int(Flags.STORED)} | changes
    item = flight.still(index, sequence, **changes)
    return pack_backlog_still(BacklogStill(item.attachment, item.encoding, item.payload))


def video_object(flight: Flight, indices: Sequence[int]) -> bytes:
    units = [flight.units[index] for index in indices]
    return pack_backlog_units([BacklogUnit(u.frame_index, u.capture_ns, u.keyframe, u.data) for u in units])


def info_object(flight: Flight) -> bytes:
    return flight.info().pack()


def chunks(
    session_id: int, kind: str, number: int, data: bytes, *, chunk_bytes: int = 1400
) -> list[Received]:
    items = []
    for offset in range(0, len(data), chunk_bytes):
        payload = data[offset : offset + chunk_bytes]
        header = BacklogHeader(
            session_id=session_id,
            kind=kind,
            number=number,
            offset=offset,
            total_bytes=len(data),
            send_ns=time.time_ns(),
        )
        items.append(
            Received("hvt/uav-1/backlog", payload, header.pack(payload), MSGPACK_ENCODING, time.time_ns())
        )
    return items
