"""Decoded base and source in, tracks and candidates out; and the ring of source frames that stills are cut from."""
