"""MPEG-TS with the base stream copied and KLV beside it (STANAG 4609).

`stream` writes it, `destination` says where to, `uas` codes the facts of a frame (MISB ST 0601 with ST 0903).
"""
