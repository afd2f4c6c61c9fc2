"""From a trajectory to a video clip."""
