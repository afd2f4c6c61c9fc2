"""Clips of the pool, evaluation films, imported clips."""
