"""Pixels and their codings.

`hevc` decodes and takes a stream apart, `still_codecs` codes stills, `base_crop` cuts the same part out of the base.
"""
