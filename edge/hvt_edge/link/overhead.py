"""Bytes beside the base stream's payload: headers, framing and ``status``."""

from __future__ import annotations

from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes

BASE_ATTACHMENT_BYTES = 48
"""The largest `BaseHeader`."""
STATUS_BYTES = 320
"""The size of a `Status`."""


def base_overhead_bps(base_bps: float, *, fps: float, edge_id: str) -> float:
    """The share of headers, framing and ``status`` in ``base_bps``: the encoder gets the rest."""
    payload = round(base_bps / 8 / fps)
    key = EdgeKeys(edge_id).key(Channel.BASE)
    encoding = DELIVERIES[Channel.BASE].encoding
    per_frame = BASE_ATTACHMENT_BYTES + overhead_bytes(
        payload, BASE_ATTACHMENT_BYTES, key=key, encoding=encoding
    )
    per_second = STATUS_BYTES + overhead_bytes(STATUS_BYTES, 0, key=EdgeKeys(edge_id).key(Channel.STATUS))
    return 8 * (per_frame * fps + per_second)
