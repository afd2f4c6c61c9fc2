"""Making, running and ending a study."""
