"""The robot's tasks, one folder each."""
