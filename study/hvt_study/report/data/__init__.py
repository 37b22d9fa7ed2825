"""Values that tables and figures share: `Setting`, `Arm`, `pairs`, `interval_of`, `METRICS`, `Report`."""
