"""Where frames come from, one file a kind: others use `opening.open_source`, the `contract`, `resample`."""
