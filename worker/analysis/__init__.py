"""Statistics, tests and figures of a study's report."""
