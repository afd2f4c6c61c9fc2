"""Tables of a study's data, data dictionary."""
