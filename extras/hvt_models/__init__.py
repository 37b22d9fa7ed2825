"""Models beyond the embedded ones: fetched and added by name (``hvt-models``), of foreign exports, merged (``A+B``).

The core finds it behind the entry points of the group ``hvt.models``.
"""
