"""Codecs that no profile uses: of stills `webp`, `avif`, `jxl`, behind `hvt.still_codecs`; of video `hardware`."""
