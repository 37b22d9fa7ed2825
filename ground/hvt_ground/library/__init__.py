"""The ground as a part of another program: `received` gives it the events."""
