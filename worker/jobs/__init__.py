"""Find what is due in the database and run it durably."""
