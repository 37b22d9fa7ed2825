"""The still codecs that no profile uses, loaded by name like a third party's: `webp`, `avif`, `jxl`."""
