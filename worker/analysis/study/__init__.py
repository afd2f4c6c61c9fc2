"""What the people of a study say, with figures."""
