"""Tables of the report, each a function of rows."""
