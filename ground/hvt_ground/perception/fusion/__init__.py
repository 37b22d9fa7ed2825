"""One list of tracks out of base, edge and stills."""
