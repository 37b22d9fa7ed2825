"""From the rows of a study to its tables, figures and pages: `write_report`, `join_studies`."""
