"""Scripts for analysts; they know only files."""
