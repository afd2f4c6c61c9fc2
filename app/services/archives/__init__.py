"""A whole study as one file: write, seal, import."""
