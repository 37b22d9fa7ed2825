"""Other people's systems, rebuilt on our codecs and our accounting, to be compared with: `fly_dds`."""
