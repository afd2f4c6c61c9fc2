"""Methods beside each other, as tables and pages."""
