"""The experimenter's pages: studies, dashboard, results."""
