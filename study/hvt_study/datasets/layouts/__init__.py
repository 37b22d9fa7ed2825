"""One module a layout of datasets, from URI to `Sequence`; others call `open_dataset`, `open_datasets` of `uri`."""
