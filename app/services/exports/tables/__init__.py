"""Each table: columns, and the rows in it."""
