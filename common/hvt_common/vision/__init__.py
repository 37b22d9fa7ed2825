"""Everything that knows pixels: codecs, models, tracking."""
