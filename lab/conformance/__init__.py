"""Vectors by which a reader of the wire in any language can be tried; `vectors` makes them."""
