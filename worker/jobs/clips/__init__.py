"""Pool clips, evaluation films, imported clips."""
