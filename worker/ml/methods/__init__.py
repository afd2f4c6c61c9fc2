"""Every method of the comparison, one interface."""
