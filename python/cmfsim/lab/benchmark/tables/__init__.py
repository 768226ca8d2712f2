"""The benchmark's tables, as values and as Markdown."""
