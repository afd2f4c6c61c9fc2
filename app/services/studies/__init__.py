"""Make a study, lock it, put it away, delete it."""
