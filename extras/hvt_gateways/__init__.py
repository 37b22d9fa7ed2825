"""Gateways to other systems: Cursor on Target (`cot`), MPEG-TS with KLV (`transport_stream`) and MCAP (`mcap`).

Each is an extra of the ground (`hvt_ground.extras`), which imports none of it; two of them share `decodable`.
"""
