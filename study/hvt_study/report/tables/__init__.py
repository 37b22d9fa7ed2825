"""Tables of the report, each a function of a `Setting` or of rows."""
