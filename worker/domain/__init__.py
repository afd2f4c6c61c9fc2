"""What all rooms share: tasks, modes, episodes."""
