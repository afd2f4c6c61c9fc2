"""What a filter is shown to do."""
