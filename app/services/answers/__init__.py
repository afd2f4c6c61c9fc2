"""Store answers, serve the next pair, check consistency."""
