"""The kinds of sources, one file each, behind the contract that `hvt_edge.source.opening` hands out."""
