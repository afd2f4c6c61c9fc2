"""Statistics of people, filters and methods."""
