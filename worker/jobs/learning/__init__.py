"""Choose pairs, fit reward models and filters."""
