"""Text for a paper and its preregistration."""
