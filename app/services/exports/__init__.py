"""Tables of a study's data and their data dictionary."""
