"""Find what is due, and run it durably."""
