"""The ground side: what edges send over the link becomes tracks, tables and recordings; `app.Ground` is all of it."""
