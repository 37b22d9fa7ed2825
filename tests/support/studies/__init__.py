"""Small data sets, studies and their rows."""
