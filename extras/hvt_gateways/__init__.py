"""Gateways to other systems: Cursor on Target (`cot`), MPEG-TS with KLV (`transport_stream`) and MCAP (`mcap`).

`decodable` is of two of them. Each is an extra of the ground (`hvt_ground.extras`): nothing of the ground imports one.
"""
