"""The robot's tasks, one folder each, and their registry."""
