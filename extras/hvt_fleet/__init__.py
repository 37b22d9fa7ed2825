"""For many edges and grounds: `pki` makes their keys and rights; `link` says why there is no link.

`edge_doctor` and `ground_doctor` examine one before a flight (`checkup`), `commands` asks an edge in flight.
"""
