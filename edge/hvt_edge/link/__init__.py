"""The edge's end of the link: `transmitter` sends, after `budget`, `pacer`, `rate_control`; `receivers` judges."""
