"""What the worker can be told, by subject."""
