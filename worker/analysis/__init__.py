"""Statistics and figures of a study's report."""
