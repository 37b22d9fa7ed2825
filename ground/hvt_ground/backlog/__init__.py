"""Objects that an edge stored while its link was down: put together, delivered, shown at their own time.

`edge_backlog` takes the chunks of one edge, which `assembly` joins, and has recordings for those of earlier sessions;
`session_backlog` shows them in the session they belong to.
"""
