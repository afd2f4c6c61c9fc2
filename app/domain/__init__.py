"""Tables: studies, pairs, answers, models."""
