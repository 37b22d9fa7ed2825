"""Datasets by URI: pictures that a flight can play, and what is really in them; one layout a file."""
