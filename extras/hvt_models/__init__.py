"""Models beyond the embedded ones: fetched and added by name (``hvt-models``), of foreign exports, merged (``A+B``).

`detectors` has others than a single network, `exports` reads foreign files. The core finds it behind the entry points
of the group ``hvt.models``.
"""
