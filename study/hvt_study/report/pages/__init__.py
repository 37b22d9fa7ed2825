"""Renders a `Report` as one HTML page or as Markdown from Jinja2 templates: `html_page`, `markdown_page`."""
