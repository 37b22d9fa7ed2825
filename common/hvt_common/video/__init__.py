"""Pixels and their codings.

`hevc` decodes, `annex_b` takes a stream apart, `still_codecs` codes stills, `base_crop` is what the base has there,
and `exact_crop` the same in whole numbers.
"""
