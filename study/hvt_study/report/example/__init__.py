"""The example flight of a report: which run, flown again, stored beside the table."""
