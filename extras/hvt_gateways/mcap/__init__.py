"""``--mcap`` and ``export --to mcap``: a session for Foxglove. `extra` declares it, `file` writes one."""
