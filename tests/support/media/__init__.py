"""Pictures, streams, still codecs and models that tests make."""
