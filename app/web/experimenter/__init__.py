"""The experimenter's pages: studies and results."""
