"""Edge and ground as processes over a bad link that a scenario file describes; ``make link``, ``make kills``."""
