"""Codecs that no profile uses.

Of stills `webp`, `avif`, `jxl`, behind `hvt.still_codecs`; of video `hardware` and `passthrough`, behind
`hvt.encoders`.
"""
