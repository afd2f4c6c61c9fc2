"""Every method that the filter is set against."""
