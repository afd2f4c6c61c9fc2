"""The tables: studies and settings, pairs, answers, models."""
