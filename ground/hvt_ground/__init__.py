"""The ground side: link to recording."""
