"""Still codecs that no profile uses, behind the entry point `hvt.still_codecs`: `webp`, `avif`, `jxl`."""
