"""Store answers, serve the next pair."""
