"""Renders a report as one HTML page or as Markdown, with Jinja2 templates."""
