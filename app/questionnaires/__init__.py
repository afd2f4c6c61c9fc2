"""Standard questionnaires, one data file each."""
